"""The steps of one drive, as the pipeline lists them."""
