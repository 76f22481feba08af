"""Commands: they parse, print and return exit statuses."""
