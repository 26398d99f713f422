"""Settings that every test shares."""

from __future__ import annotations

from hypothesis import settings

# The same examples on every machine and in every run: a failure can be repeated, and no deadline depends on the load.
settings.register_profile("fracsim", derandomize=True, deadline=None, max_examples=40, database=None)
settings.load_profile("fracsim")
