"""What a config takes from other runs, by content: networks to start from (`init_from`), a curriculum to follow."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from space_dist.config import RunConfig
from space_dist.run.recording import recording_in
from space_dist.run.starting import weights_in

_READ: Final[Mapping[str, Callable[[Path], bytes]]] = {"init_from": weights_in, "curriculum.of": recording_in}


def given_to(config: RunConfig) -> dict[str, bytes]:
    """What each of `RunConfig.given_paths` holds, by its key. Raises ConfigError where that cannot be used."""
    return {key: _READ[key](path) for key, path in config.given_paths.items()}
