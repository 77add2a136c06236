"""report.html: one file that any browser opens, without a network."""
