"""What the laboratory adds to the product, by name (workflow/plugins.py)."""

# ----------------------------------------------------------------------- rooms with ground truth, and what needs it

KINDS = {
    "source": {
        "builtin": ("lab.sources.builtin", "lab.settings.source:BuiltinSource"),
        "drawn": ("lab.sources.drawn", "lab.settings.source:DrawnSource"),
        "mitsuba": ("lab.sources.mitsuba", "lab.settings.source:MitsubaSource"),
    },
    "prior": {"simulated": ("lab.simulated.prior", "lab.settings.prior:SimulatedPrior")},
}
TRUTH = ("simulated",)
ADDED = {
    "base_scores": {
        "does": "Score the base texture; made on demand by studies.",
        "place": "lab.studies.base_scores",
        "upstream": ("capture", "prior", "segmentation", "base"),
        "settings": (),
        "reads_raw": True,
        "files": ("lab.studies.weights",),
        "scores": True,
    },
    "common_scores": {
        "does": "Score the result at views that all variants of a study share; made on demand by studies.",
        "place": "lab.studies.common_scores",
        "upstream": ("capture", "segmentation", "base", "emission", "second_look", "affines"),
        "settings": ("seed",),
        "shared": ("capture", "segmentation"),
        "scores": True,
    },
    "relit_truth": {
        "does": "Render the source of a scene with truth under new light; made on demand by studies.",
        "place": "lab.relit.truth",
        "upstream": ("capture",),
        "settings": ("source", "relit", "seed"),
        "reads_raw": True,
        "files": ("lab.relit.sources",),
        "scores": True,
    },
    "relit_scores": {
        "does": "Render the result under new light and score it against the source; made on demand by studies.",
        "place": "lab.relit.scores",
        "upstream": ("capture", "segmentation", "base", "emission", "second_look", "affines", "relit_truth"),
        "settings": ("relit", "seed"),
        "scores": True,
    },
}
SIZES = {"builtin": "lab.work:faces_of_room", "mitsuba": "lab.work:faces_of_files"}
COSTS = {
    "base_scores": "lab.work:base_scores",
    "common_scores": "lab.work:common_scores",
    "builtin": "lab.work:rendered",
    "drawn": "lab.work:rendered",
    "mitsuba": "lab.work:rendered",
    "relit_truth": "lab.work:relit_truth",
    "relit_scores": "lab.work:relit_scores",
}
SCENES = "lab/config/scenes"
DERIVED = "lab.studies.variants"
QUALITY = "lab/config/quality"

# ------------------------------- the published method and baselines, and settings that the product holds constant

SECTIONS = {
    "capture": "lab.settings.capture:Capture",
    "prior.learned": "lab.settings.prior:LearnedPrior",
    "prior.retinex": "lab.settings.prior:RetinexPrior",
    "prior.files": "lab.settings.prior:FilesPrior",
    "prior.rgbx": "lab.settings.prior:RgbxPrior",
    "prior.marigold": "lab.settings.prior:MarigoldPrior",
    "prior.pooled": "lab.settings.pooled:PooledPrior",
    "segmentation.given": "lab.settings.segmentation:GivenSegmentation",
    "segmentation.masks": "lab.settings.segmentation:MaskSegmentation",
    "segmentation.geometry": "lab.settings.segmentation:GeometrySegmentation",
    "base": "lab.settings.methods:Base",
    "emission": "lab.settings.methods:Emission",
    "shading": "lab.settings.methods:Shading",
    "affines": "lab.settings.methods:Affines",
    "scene": "lab.settings.scene:LabScene",
}
STAGES = {stage: f"lab.methods:{stage}" for stage in ("plan", "base", "emission", "shading", "second_look", "affines")}
