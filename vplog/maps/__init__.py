"""Maps of many drives: storage, search, joining, merging, export and removal."""
