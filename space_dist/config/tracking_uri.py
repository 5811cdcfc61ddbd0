"""Tracking URIs: of which stores there can be a mirror."""

from __future__ import annotations

from typing import Final
from urllib.parse import urlsplit

ALLOWED: Final = "allowed are sqlite:////absolute/path/mlflow.db and http(s)://HOST:PORT of an MLflow server"
_SQLITE: Final = "sqlite:///"


class UriError(ValueError):
    """What is wrong with a tracking URI: a sentence that shows of it what may be shown."""


def checked_uri(uri: str) -> str:
    """The URI, less slashes at the end of a server's.

    Raises UriError for a store that is not mirrored to, with a sentence that repeats no password.
    """
    shown = "" if "@" in uri else f" {uri!r}"
    try:
        parts = urlsplit(uri)
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
    if parts.scheme == "sqlite":
        name = uri.removeprefix(_SQLITE)
        if name in (uri, "", ":memory:") or name.endswith("/") or "?" in name or "\0" in name:
            raise UriError(f"the tracking URI{shown} names no database file; {ALLOWED}")
        return uri
    if parts.scheme in ("", "file"):
        raise UriError(f"the tracking URI{shown} is a folder of files, which MLflow no longer supports; {ALLOWED}")
    raise UriError(f"a tracking URI of the kind {parts.scheme}: cannot be mirrored to; {ALLOWED}")
