"""Parts of the `folder` source: `transforms` (cameras), `images`, `mesh`, `alignment`, `exposure`."""
