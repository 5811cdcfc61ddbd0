"""How long tests wait for what other processes do."""

from __future__ import annotations

PATIENCE = 500.0
"""Seconds before a wait counts as a hang: many times what a busy machine takes. pytest's own limit is longer, so that
a test that gives up can still say what it has waited for."""
