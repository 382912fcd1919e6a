"""Speed against accuracy: the points of the measured front, and which of them a budget or a target asks for
(docs/guide/quality.md)."""
