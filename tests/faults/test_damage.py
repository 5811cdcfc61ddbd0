"""Files of a run that were cut short or changed: noticed by every command, and never a wrong result for a right one."""

from __future__ import annotations

import random
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from space_dist import config as configs
from space_dist.envs.spec import EnvironmentSpec
from space_dist.errors import LedgerError, SpaceDistError
from space_dist.ledger import METRICS, ROW_FILES, Checkpoint, Ledger, RunWriter, decode_checkpoint
from space_dist.ledger import folder as folder_module
from space_dist.ledger import writer as writer_module
from space_dist.report import load_run
from space_dist.run.building import spec_of
from space_dist.run.claiming import stored_config
from space_dist.run.launch import launch, policy_of
from space_dist.system.files import read_file
from space_dist.system.interrupts import StopRequests
from tests.faults.test_every_write import short
from tests.test_learners import results

SMALL = 64 << 10  # bytes: files below it are cut at every length
# What nobody takes results from.
NOT_READ = ("lock.json", "log.txt")


@pytest.fixture(scope="module", params=["done", "interrupted"])
def original(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Path, Any, Any]:
    """A run of DQN (so that there are pieces of a replay buffer): its config, folder, results, and what is read."""
    folder = tmp_path_factory.mktemp("damage")
    config = short(folder, "dqn", 4)
    launch(config, folder / "reference", resume=True, stop=StopRequests())
    if request.param == "interrupted":
        half = iter((None, "the test"))
        stop = StopRequests()
        stop.reason = lambda: next(half)  # type: ignore[method-assign]
        with pytest.raises(SpaceDistError, match="stopped by the test"):
            launch(config, folder / "run", resume=True, stop=stop)
    else:
        shutil.copytree(folder / "reference", folder / "run")
    ledger = Ledger(folder / "run")
    assert ledger.status().state == request.param
    return config, folder / "run", results(folder / "reference"), read(ledger, spec_of(config))


@pytest.fixture
def copy(original: tuple[Any, Path, Any, Any], tmp_path: Path) -> Path:
    """The run once more, to be damaged."""
    return Path(shutil.copytree(original[1], tmp_path / "run"))


def read(ledger: Ledger, spec: EnvironmentSpec) -> dict[str, Any]:
    """What `evaluate`, `report` and `sync` take from a run; a refusal is the sentence alone."""

    def policy() -> Any:
        chosen = policy_of(ledger, spec)
        return [(name, array.tobytes()) for name, array in sorted(arrays_of(chosen))]

    def report() -> Any:
        run = load_run(ledger)
        return (
            run.status.state, run.status.steps, run.instance_ids.tolist(), run.evaluation_steps.tolist(),
            {name: values.tolist() for name, values in run.test.items()}, [one.tolist() for one in run.trained],
            run.config["learner"], run.config["seed"],
        )  # fmt: skip

    def sync() -> Any:
        return ledger.rows(METRICS, committed_only=True), stored_config(ledger).seed

    answers: dict[str, Any] = {}
    for command in (policy, report, sync):
        try:
            answers[command.__name__] = repr(command())
        except SpaceDistError as error:
            answers[command.__name__] = error
    return answers


def arrays_of(policy: Any) -> Iterator[tuple[str, np.ndarray]]:
    for part, layers in (("actor", policy.actor), *((f"critic{i}", c) for i, c in enumerate(policy.critics))):
        for index, (weights, biases) in enumerate(layers):
            yield f"{part}{index}w", weights
            yield f"{part}{index}b", biases


def files_of(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file() and path.name not in NOT_READ)


def readable_as_before_or_refused(folder: Path, spec: EnvironmentSpec, before: dict[str, Any]) -> int:
    """How many of the commands refused."""
    now = read(Ledger(folder), spec)
    for command, answer in now.items():
        if not isinstance(answer, SpaceDistError):
            assert answer == before[command], command
    return sum(isinstance(answer, SpaceDistError) for answer in now.values())


def resumes_to_the_same_bytes_or_is_refused(config: configs.RunConfig, folder: Path, right: dict[str, bytes]) -> bool:
    try:
        launch(config, folder, resume=True, stop=StopRequests())
    except SpaceDistError:
        return False
    assert results(folder) == right
    return True


def test_every_file_cut_short_and_changed(original: tuple[Any, Path, Any, Any], copy: Path) -> None:
    """What a resumption reads is cut at every length in the interrupted run, the rest in the one that is done."""
    config, _, _, before = original
    spec, ledger, rng = spec_of(config), Ledger(copy), random.Random(0)
    done = ledger.status().state == "done"
    cut = changed = 0
    with RunWriter(ledger) as writer:
        newest = decode_checkpoint(ledger.checkpoint_files()[0].read_bytes())
        for path in files_of(copy):
            content = path.read_bytes()
            lengths = sorted(rng.sample(range(len(content)), min(len(content), 20)))
            if len(content) < SMALL and done == (path.suffix != ".npz" or path.parent == copy):
                lengths = list(range(len(content)))
            for length in lengths:
                path.write_bytes(content[:length])
                noticed_by_its_reader(ledger, writer, newest, path)
                cut += 1
            for length in rng.sample(lengths, 10):  # what commands make of it takes some ms
                path.write_bytes(content[:length])
                readable_as_before_or_refused(copy, spec, before)
            for _ in range(25):
                at, change = rng.randrange(len(content)), rng.randrange(1, 256)
                path.write_bytes(content[:at] + bytes([content[at] ^ change]) + content[at + 1 :])
                readable_as_before_or_refused(copy, spec, before)
                changed += 1
            path.write_bytes(content)
    assert readable_as_before_or_refused(copy, spec, before) == 0
    assert cut > 8_000
    assert changed >= 250  # in each of two runs


def noticed_by_its_reader(ledger: Ledger, writer: RunWriter, newest: Checkpoint, path: Path) -> None:
    if path.parent == ledger.checkpoints:
        with pytest.raises(ValueError):  # noqa: PT011 - any reason will do
            decode_checkpoint(path.read_bytes())
    elif path.parent == ledger.replay:
        if path.name in {segment.name for segment in newest.segments}:
            with pytest.raises(ValueError, match="has changed since"):
                writer._verified_prefixes(newest)
    elif path.name in ROW_FILES:
        with pytest.raises(LedgerError, match="damaged"):
            ledger.rows(path.name)
    elif path.name == "status.json":
        with pytest.raises(LedgerError, match="damaged"):
            ledger.status()
    else:
        with pytest.raises(LedgerError, match="damaged"):
            ledger.read(path)


def test_damaged_runs_are_resumed_to_the_same_bytes_or_refused(
    original: tuple[Any, Path, Any, Any], tmp_path: Path
) -> None:
    config, folder, right, _ = original
    rng = random.Random(1)
    resumed = refused = 0
    for path in files_of(folder):
        content = path.read_bytes()
        name = path.relative_to(folder)
        at = rng.randrange(len(content))
        flipped = content[:at] + bytes([content[at] ^ (1 << rng.randrange(8))]) + content[at + 1 :]
        damages = [content[: rng.randrange(len(content))], None, flipped]
        for number, damage in enumerate(damages):
            copy = tmp_path / f"{name.name}-{number}"
            shutil.copytree(folder, copy)
            if damage is None:
                (copy / name).unlink()
            else:
                (copy / name).write_bytes(damage)
            if resumes_to_the_same_bytes_or_is_refused(config, copy, right):
                resumed += 1
            else:
                refused += 1
            shutil.rmtree(copy)
    assert resumed > refused > 0


def test_two_damages_at_once(original: tuple[Any, Path, Any, Any], tmp_path: Path) -> None:
    config, folder, right, _ = original
    pairs = (("status.json", "config.yaml"), ("status.json", METRICS), ("config.yaml", "timing.jsonl"))
    for number, names in enumerate(pairs):
        copy = tmp_path / str(number)
        shutil.copytree(folder, copy)
        for name in names:
            content = (copy / name).read_bytes()
            (copy / name).write_bytes(content[: len(content) // 2])
        resumes_to_the_same_bytes_or_is_refused(config, copy, right)


def test_emptied_checkpoints_are_not_started_over_in_silence(original: tuple[Any, Path, Any, Any], copy: Path) -> None:
    config = original[0]
    for path in (copy / "checkpoints").iterdir():
        path.unlink()
    before = {path: path.read_bytes() for path in copy.rglob("*.jsonl")}
    if Ledger(copy).status().state == "done":
        assert launch(config, copy, resume=True, stop=StopRequests()).already_done
        (copy / "model.npz").write_bytes(b"damaged")
    with pytest.raises(SpaceDistError, match=r"cannot be resumed: no checkpoint is intact \(round-\d+\.npz: missing\)"):
        launch(config, copy, resume=True, stop=StopRequests())
    assert {path: path.read_bytes() for path in copy.rglob("*.jsonl")} == before


def test_a_run_that_is_done_goes_back_as_any_other(original: tuple[Any, Path, Any, Any], copy: Path) -> None:
    config, _, right, _ = original
    if Ledger(copy).status().state != "done":
        return
    newest, older = Ledger(copy).checkpoint_files()
    newest.write_bytes(newest.read_bytes()[:100])
    with pytest.raises(LedgerError, match="is damaged; `train --resume` goes back to the one before it"):
        Ledger(copy).last_checkpoint()
    assert resumes_to_the_same_bytes_or_is_refused(config, copy, right)
    with (copy / METRICS).open("a") as file:
        file.write("garbage\n")
    assert resumes_to_the_same_bytes_or_is_refused(config, copy, right)
    assert older.name < newest.name == Ledger(copy).checkpoint_files()[0].name
    for path in Ledger(copy).checkpoint_files():
        path.write_bytes(b"damaged")
        path.rename(newest)  # leaves one
    with pytest.raises(LedgerError, match="is damaged; no other is intact"):
        Ledger(copy).last_checkpoint()
    before = (copy / "status.json").read_bytes()
    assert launch(config, copy, resume=True, stop=StopRequests()).already_done
    assert (copy / "status.json").read_bytes() == before


def test_after_a_fallback_the_status_names_the_checkpoint_that_is_used(copy: Path) -> None:
    newest, older = Ledger(copy).checkpoint_files()
    newest.write_bytes(newest.read_bytes()[:-1])
    with RunWriter(Ledger(copy)) as writer:
        writer.status = Ledger(copy).status()
        checkpoint = writer.restore()
    assert checkpoint is not None
    status = Ledger(copy).status()
    assert (status.checkpoint, status.round) == (older.name, checkpoint.round)
    assert Ledger(copy).checkpoint_files() == [older]
    assert {name: (copy / name).stat().st_size for name in ROW_FILES} == dict(status.committed)


def test_going_back_is_said_outside_of_the_log_too(
    original: tuple[Any, Path, Any, Any], copy: Path, caplog: pytest.LogCaptureFixture
) -> None:
    config, _, right, _ = original
    newest = Ledger(copy).checkpoint_files()[0]
    newest.write_bytes(newest.read_bytes()[:100])
    assert resumes_to_the_same_bytes_or_is_refused(config, copy, right)
    said = f"{newest.name}, is damaged; computing it again from the last checkpoint that is intact"
    assert said in caplog.text
    # Before the log was opened: then it went to standard error.
    assert said not in (copy / "log.txt").read_text()
    caplog.clear()
    for path in Ledger(copy).checkpoint_files():
        path.write_bytes(b"damaged")
    if Ledger(copy).status().state != "done":
        with pytest.raises(LedgerError, match="no checkpoint is intact"):
            launch(config, copy, resume=True, stop=StopRequests())
    assert "computing it again" not in caplog.text


def test_a_checkpoint_that_cannot_be_read_now_is_not_thrown_away(
    original: tuple[Any, Path, Any, Any], copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = original[0]
    (copy / "status.json").unlink()  # a run that is done is not restored
    checkpoints = Ledger(copy).checkpoint_files()

    def unreadable(path: Path, limit: int = -1) -> bytes:
        if path == checkpoints[0]:
            raise OSError(5, "Input/output error")
        return read_file(path, limit)

    monkeypatch.setattr(folder_module, "read_file", unreadable)
    monkeypatch.setattr(writer_module, "read_file", unreadable)
    with pytest.raises(SpaceDistError, match=r"cannot be resumed now: .* cannot be read \(Input/output error\)"):
        launch(config, copy, resume=True, stop=StopRequests())
    assert Ledger(copy).checkpoint_files() == checkpoints
