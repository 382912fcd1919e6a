"""Assigns faces to objects: one plug-in module per kind, chosen by `segmentation: {kind: ...}`.

A plug-in is a module `workflow/segmentations/<kind>.py` with

    segment(surface, settings, fold) -> Objects
    PERTURBED                            what the perturbed runs change, as text
    perturbs(surface) -> bool            whether they change anything

`surface` holds mesh and photographs (workflow/segmentations/surface.py), and `settings` are the sections that stage segmentation
reads. `fold` is None for the result, and 0 ... FOLDS - 1 for the perturbed runs that measure its stability; they leave out the
photographs of that fold (`Surface.views`). Two functions are optional:

    raw_inputs(document) -> list[Path]   files from outside that it reads; called while Snakemake plans, refuses missing files
    prepare(job, surface)                called once before all runs
"""
