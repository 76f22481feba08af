"""The ground under everything: errors, files, start-up. Knows no robot."""
