"""Small dense algebra: what is written for speed alone."""
