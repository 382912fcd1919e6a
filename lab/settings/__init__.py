"""Settings that the laboratory adds to those of the product (lab/plugins.py)."""

import workflow.settings  # noqa: F401  reads these classes while it is imported itself
