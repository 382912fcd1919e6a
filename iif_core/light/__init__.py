"""Light: what shines, how light travels, and what arrives (docs/method/light.md, docs/method/shading.md).

`emission` finds emitters and their radiance, `transport` traces paths, `environment` is the map of light from outside,
`irradiance` estimates light from the photographs alone, `relighting` moves cameras and lamps.
"""
