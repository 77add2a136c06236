"""Maps of many drives: data sets that grow drive by drive, and what is asked of them."""
