"""Answers of an MLflow server, bounded: whole within a time, retries included, and of so many bytes once unpacked.

requests' own timeout is that of a single read: a server that sends a byte now and then, asks for another try in an
hour, or sends us on from address to address, is waited for without end. So each request is made by a thread of its own,
which is left behind when it is late.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Mapping
from typing import Any, Final

import requests
from requests.utils import super_len

from space_dist.system.extras import needed_from

SECONDS: Final = 20.0  # for a request and its answer, retries and redirections included
_BYTES_A_SECOND: Final = 100_000  # of what is sent, for which there is more time
MAX_BYTES: Final = 64 << 20  # of an answer; the largest that we ask for are pages of 200 runs
_CHUNK: Final = 1 << 16
_UNTIL: Final = "space_dist until"  # a key of a request's hooks, of which requests calls none but its own


def bound_answers() -> None:
    """Have MLflow's requests bounded in this process. To be called before the first one; again changes nothing."""
    with needed_from("mlflow", "the mirror in MLflow", "use tracking.uri=null"):
        from mlflow.utils import request_utils

    if getattr(request_utils.TCPKeepAliveHTTPAdapter, "bounded", False):
        return

    class Bounded(request_utils.TCPKeepAliveHTTPAdapter):  # MLflow's sessions send through it
        bounded = True

        def send(self, request: requests.PreparedRequest, stream: bool = False, *rest: Any, **named: Any) -> Any:
            limit = SECONDS + (super_len(request.body) if request.body else 0) / _BYTES_A_SECOND
            # A redirection is another request, a copy of the one before, with which it has its hooks in common.
            hooks: Any = request.hooks
            until: float = hooks.setdefault(_UNTIL, time.monotonic() + limit)
            answers: queue.SimpleQueue[requests.Response | Exception] = queue.SimpleQueue()

            def ask() -> None:
                try:
                    response = super(Bounded, self).send(request, True, *rest, **named)
                    if not stream:
                        _take(response, until)
                    answers.put(response)
                except Exception as error:
                    answers.put(error)

            threading.Thread(target=ask, name="mlflow-request", daemon=True).start()
            try:
                answer = answers.get(timeout=max(0.0, until - time.monotonic()))
            except queue.Empty:
                raise requests.Timeout(f"no whole answer within {limit:.0f} s", request=request) from None
            if isinstance(answer, Exception):
                raise answer
            return answer

    request_utils.TCPKeepAliveHTTPAdapter = Bounded  # type: ignore[misc]


def _take(response: requests.Response, until: float) -> None:
    """Read an answer's content. Raises RequestException if it is too large, or late."""
    content = bytearray()
    for chunk in response.iter_content(_CHUNK):
        content += chunk
        if len(content) > MAX_BYTES:
            response.close()
            raise requests.exceptions.ContentDecodingError(f"its answer is larger than {MAX_BYTES >> 20} MiB")
        if time.monotonic() > until:
            response.close()
            raise requests.Timeout("its answer takes too long")
    response._content = bytes(content)  # where requests itself puts it


ENVIRONMENT: Final[Mapping[str, str]] = {
    # MLflow's own defaults wait for a dead server for minutes, and for as long as a server asks for.
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",  # seconds
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "2",
    "MLFLOW_HTTP_REQUEST_BACKOFF_FACTOR": "1",
    "MLFLOW_HTTP_RESPECT_RETRY_AFTER_HEADER": "false",
}
