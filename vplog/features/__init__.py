"""Features of images, by SIFT or by networks that users bring, and where they wait for verification."""
