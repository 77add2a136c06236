"""Places of a map that look like a query, exactly and by index."""
