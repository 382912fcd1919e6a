"""Light: what shines, how light travels, and what arrives (docs/method/light.md, docs/method/shading.md)."""
