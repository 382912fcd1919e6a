"""Parts of the `mitsuba` source, in the order in which they are used.

`document` lists the files of a scene, `scene` loads it and lists its shapes, `flatten` merges them into one mesh, `materials`
converts BSDFs to albedo, roughness and metallic, `path` chooses cameras, and `render` makes the photographs.
"""
