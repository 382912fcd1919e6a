"""Parts that all sources of photographs share.

`inputs` lists the files, `transforms` and `colmap` read cameras, `images` and `mesh` read what their names say; `alignment`,
`registration` and `exposure` compare the photographs with the mesh and with each other.
"""
