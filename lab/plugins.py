"""What the laboratory adds to the product, by name (workflow/plugins.py)."""

from __future__ import annotations

KINDS: dict[str, dict[str, tuple[str, str]]] = {}
