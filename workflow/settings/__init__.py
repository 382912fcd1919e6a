"""The settings of a scene: one typed model that validates, documents and generates (schema, defaults, reference page).

Order of precedence: defaults here < `config/quality/<quality>.yaml` < `config/scenes/<scene>.yaml`; for a variant of a study
(study_files.py) also < `config/studies/scenes.yaml` < `config/studies/<study>.yaml`; for a line of `config/batch.tsv`
(batch_table.py) its base stands in the place of the scene's file, under the line's columns.
Nothing else is consulted: no environment variables, no hidden files.
"""

from workflow.settings.document import reference_markdown, schema_json
from workflow.settings.loading import load, scene_file, scene_origin
from workflow.settings.names import QUALITIES, RESERVED, SCENE_NAME, scene_names
from workflow.settings.relight import relight_files, require_relighting
from workflow.settings.scene import UNIONS, SceneSettings, dump, select
from workflow.settings.section import Section
from workflow.settings.yaml_file import read_yaml

__all__ = [
    "QUALITIES",
    "RESERVED",
    "SCENE_NAME",
    "UNIONS",
    "SceneSettings",
    "Section",
    "dump",
    "load",
    "read_yaml",
    "reference_markdown",
    "relight_files",
    "require_relighting",
    "scene_file",
    "scene_names",
    "scene_origin",
    "schema_json",
    "select",
]
