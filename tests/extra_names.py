"""The names of a plug-in: a kind of source, a field of `base`, and a solver in the place of stage base."""

KINDS = {"source": {"extra": ("tests.extra.source", "tests.extra.settings:ExtraSource")}}
SECTIONS = {"base": "tests.extra.settings:Base", "scene": "tests.extra.scene:Scene"}
STAGES = {"base": "tests.extra.settings:solver"}
READS = {"base": ("capture.dynamic_range",)}
ADDED = {
    "weigh": {"does": "Weigh the room.", "place": "tests.extra.weigh", "upstream": ("capture",), "settings": ("weight", "seed")}
}
