"""Speed against accuracy: the measured qualities, and which of them a time or a score asks for (docs/guide/quality.md)."""
