"""Parts of the `folder` source: `inputs` (which files), `transforms` and `colmap` (cameras), `images`, `mesh`, `alignment`,
`registration`, `exposure`."""
