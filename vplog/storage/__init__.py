"""Files, links and buckets."""
