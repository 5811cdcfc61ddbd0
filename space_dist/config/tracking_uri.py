"""Tracking URIs: of which stores there can be a mirror, and what the environment says of it.

A config comes first, then MLflow's own variables in the environment, then the default. What they say is settled once,
when a run begins or a grid is frozen, and written down with it: whoever mirrors it later needs no environment.
"""

from __future__ import annotations

import os
import re
from typing import Final
from urllib.parse import urlsplit

from space_dist.errors import ConfigError

ALLOWED: Final = (
    "allowed are sqlite:///mlflow.db (in the current folder), sqlite:////absolute/path/mlflow.db, and "
    "http(s)://HOST:PORT of an MLflow server"
)
AUTO: Final = "auto"
DEFAULT: Final = "sqlite:///mlflow.db"
URI_VARIABLE: Final = "MLFLOW_TRACKING_URI"
EXPERIMENT_VARIABLE: Final = "MLFLOW_EXPERIMENT_NAME"
_SQLITE: Final = "sqlite:///"
_DATABASES: Final = (".db", ".sqlite", ".sqlite3")  # how a file's name ends that is meant as one
_MAX_EXPERIMENT: Final = 200


class UriError(ValueError):
    """What is wrong with a tracking URI: a sentence that shows of it what may be shown."""


def settled_uri(uri: str | None) -> str | None:
    """What a config's `tracking.uri` comes to here and now: `auto` is the environment's, and the default without.

    Raises ConfigError for a store in the environment that is not mirrored to.
    """
    if uri != AUTO:
        return uri
    given = os.environ.get(URI_VARIABLE, "")
    try:
        return checked_uri(given) if given else DEFAULT
    except UriError as error:
        raise ConfigError(
            f"{URI_VARIABLE} of the environment, which decides as tracking.uri is auto: {error}; tracking.uri: null "
            "mirrors nowhere"
        ) from None


def settled_experiment(experiment: str | None, default: str) -> str:
    """What a config's `tracking.experiment` comes to here and now: null is the environment's, and `default` without.

    Raises ConfigError for a name in the environment that is too long.
    """
    if experiment is not None:
        return experiment
    given = os.environ.get(EXPERIMENT_VARIABLE, "")
    if len(given) > _MAX_EXPERIMENT or not given.isprintable():
        raise ConfigError(
            f"{EXPERIMENT_VARIABLE} of the environment must be a printable name of at most {_MAX_EXPERIMENT} characters"
        )
    return given or default


def checked_uri(uri: str) -> str:
    """The URI, less slashes at the end of a server's.

    Raises UriError for a store that is not mirrored to, with a sentence that repeats no password.
    """
    # What may hold a password is not repeated.
    shown = "" if "@" in uri else f" {uri!r}"
    try:
        parts = urlsplit(uri)
        # `port` raises ValueError for what is no number.
        host, port, has_credentials = parts.hostname, parts.port, "@" in parts.netloc
    except ValueError:
        raise UriError(f"the tracking URI{shown} is not a URI; {ALLOWED}") from None
    if parts.scheme in ("http", "https"):
        if has_credentials:
            raise UriError(
                "the tracking URI contains credentials, which would be stored with every run; give them in the "
                f"environment: MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD; {ALLOWED}"
            )
        if not host or port == 0 or any(character.isspace() for character in uri):
            raise UriError(f"the tracking URI{shown} names no server; {ALLOWED}")
        if parts.query or parts.fragment:
            raise UriError(f"the tracking URI for {host} has more than a path after its host; {ALLOWED}")
        return uri.rstrip("/")
    if re.fullmatch(r"[\w.-]+:\d+(/.*)?", uri):
        raise UriError(f"the tracking URI {uri!r} lacks its beginning: http://{uri}, of an MLflow server")
    if parts.scheme == "sqlite":
        name = uri.removeprefix(_SQLITE)
        if name in (uri, "", ":memory:") or name.endswith("/") or "?" in name or "\0" in name:
            raise UriError(f"the tracking URI{shown} names no database file; {ALLOWED}")
        return uri
    if parts.scheme == "" and (uri.endswith(_DATABASES) or not ("/" in uri or uri == "mlruns")):  # no path of a folder
        nearest = f"; did you mean {_SQLITE}{uri}?" if uri.endswith(_DATABASES) and shown else ";"
        raise UriError(f"the tracking URI{shown} has no beginning that says what it is{nearest} {ALLOWED}")
    if parts.scheme in ("", "file"):
        raise UriError(f"the tracking URI{shown} is a folder of files, which MLflow no longer supports; {ALLOWED}")
    raise UriError(f"a tracking URI of the kind {parts.scheme}: cannot be mirrored to; {ALLOWED}")
