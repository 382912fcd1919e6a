"""Which face belongs to which object: one module a kind, chosen by `segmentation: {kind: ...}`.

Each has

    segment(surface, settings, fold) -> Objects

`surface` is what all kinds read (workflow/segmentations/surface.py), `settings` what stage segmentation sees. `fold` is None
for the result, and 0 ... FOLDS - 1 for the perturbed runs that its stability is measured by: the photographs of that fold
are left out (`Surface.views`). A kind that reads files from outside also has `raw_inputs(document) -> list[Path]`, called
while Snakemake plans; it names what is missing. One that has something to make once, before all runs, has `prepare(job,
surface)`. `PERTURBED` says in words what the runs change, `perturbs(surface)` whether
they change anything.
"""
