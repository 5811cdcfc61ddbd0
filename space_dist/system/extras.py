"""Libraries that only some work needs: where one is missing, a sentence that names the extra which brings it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Final, Literal

from space_dist.errors import ConfigError

Extra = Literal["ray", "mlflow", "bullet", "tune"]

_NAMES: Final[dict[Extra, tuple[str, str]]] = {
    "ray": ("Ray", "ray"), "mlflow": ("MLflow", "mlflow"), "bullet": ("PyBullet", "pybullet"),
    "tune": ("Optuna", "optuna"),
}  # fmt: skip


@contextlib.contextmanager
def needed_from(extra: Extra, what: str, instead: str = "") -> Iterator[None]:
    """Around the import of an extra's library, for `what`: the subject of the sentence if it cannot be imported.

    instead: what does without it, as the end of the sentence. Raises ConfigError where the library, or a part of it,
    is missing; any other fault of an import is passed on.
    """
    title, module = _NAMES[extra]
    try:
        yield
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        # Our own fault, and no library's: no package would mend it.
        if missing == "space_dist":
            raise
        part = "" if missing in (module, f"{module}_data") else f" ({title} is here, but it lacks {missing!r})"
        raise ConfigError(
            f"{what} needs {title}{part}: pip install 'space-dist[{extra}]'" + (f", or {instead}" if instead else "")
        ) from error
