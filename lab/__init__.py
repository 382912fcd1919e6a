"""The laboratory: it measures what the product does, and makes what the product ships (docs/development/architecture.md).

`lab` imports `iif_core` and `workflow`; neither ever imports `lab` (a contract in `pyproject.toml`). Importing it registers its
plug-in (lab/plugins.py) for this process and its children, if it happens before the settings of the product are imported.
"""

import os

_NAMED = os.environ.get("IIF_PLUGINS", "")
if "lab.plugins" not in _NAMED.split(","):
    os.environ["IIF_PLUGINS"] = ",".join(filter(None, [_NAMED, "lab.plugins"]))
