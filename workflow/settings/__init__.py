"""The settings of a scene: one typed model that validates them, of which the JSON schema and the reference page are made.

Order of precedence: defaults in this package < `config/quality/<quality>.yaml` < `config/scenes/<scene>.yaml` < what a derived
scene puts over it (derived.py), such as a plan of relightings; for a line of `config/batch.tsv` (batch_table.py) its base takes
the place of the file of the scene, under the columns of the line. `names.configuration` says when these files are those of the
working folder and when those of the repository. Nothing else is consulted: no environment variables, no hidden files.
"""

from workflow.settings.loading import load, relight_origin, scene_file, scene_origin
from workflow.settings.names import QUALITIES, RESERVED, SCENE_NAME, scene_names
from workflow.settings.relight import relight_files, require_relighting
from workflow.settings.relight_plans import active_plan, plan_names
from workflow.settings.scene import UNIONS, SceneSettings, dump, recorded, select
from workflow.settings.section import Section
from workflow.settings.targets import refuse_profile, refuse_target
from workflow.settings.yaml_file import read_yaml

__all__ = [
    "QUALITIES",
    "RESERVED",
    "SCENE_NAME",
    "UNIONS",
    "active_plan",
    "SceneSettings",
    "Section",
    "dump",
    "load",
    "plan_names",
    "read_yaml",
    "recorded",
    "refuse_profile",
    "refuse_target",
    "relight_files",
    "relight_origin",
    "require_relighting",
    "scene_file",
    "scene_names",
    "scene_origin",
    "select",
]
