"""The golden bits on an AMD with AVX2 and FMA alone, emulated."""

from tests.golden.on_another_cpu import *  # noqa: F403 - its tests, about this CPU

CPU = "EPYC-Rome"
