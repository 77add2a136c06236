"""Data sets as they are published, one module a layout: each becomes the streams that a recorder would have written."""
