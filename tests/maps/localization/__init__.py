"""Pictures localised in runs and maps."""
