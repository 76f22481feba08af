"""Commands: option parsing, printing and exit statuses."""
