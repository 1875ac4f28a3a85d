"""Pages and what they print; a part of `make test-tools`."""
