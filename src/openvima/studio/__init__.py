"""The studio: episodes, policies and data in a browser, on viser."""
