"""Files, folders and buckets: how they are read, written, hashed, and kept in the user's cache."""
