"""What each command line verb does, without its printing."""
