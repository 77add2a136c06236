"""Files of a run, written and read: tables, records, MCAP, g2o, COLMAP and the report."""
