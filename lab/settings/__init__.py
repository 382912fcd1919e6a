"""Settings that the laboratory adds to those of the product (lab/plugins.py)."""

import workflow.settings  # noqa: F401  before the modules of this package, whose classes it reads
