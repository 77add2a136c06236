"""Local features of images: how they are found, and where they wait for verification."""
