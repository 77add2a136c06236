"""Maps of many drives: storage, search, localisation, joining, merging, export and removal."""
