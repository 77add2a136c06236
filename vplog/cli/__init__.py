"""The command line: parses arguments, calls the verbs, prints."""
