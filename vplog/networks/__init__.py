"""Neural networks that users bring: their files, and the pixels that go into them."""
