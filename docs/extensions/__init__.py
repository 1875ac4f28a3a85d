"""What the site needs besides Sphinx."""
