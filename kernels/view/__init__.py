"""Camera rays and downsampling of pictures."""
