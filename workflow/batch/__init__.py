"""Many scenes: the batch table, what became of each scene, and the page that shows it."""
