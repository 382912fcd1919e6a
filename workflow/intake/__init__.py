"""The door for files that strangers made: what they may hold at most, and readers that refuse the rest by name (SECURITY.md)."""
