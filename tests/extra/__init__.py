"""A plug-in for tests of plug-ins, tests/extra_names.py."""

import workflow.settings  # noqa: F401  before the classes of this package, which it reads
