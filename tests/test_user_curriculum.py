"""Anyone's own curriculum, by import path: the example in the documentation, the same bytes wherever it is made."""

# ruff: noqa: F811 - a fixture that is imported
from __future__ import annotations

import re
from pathlib import Path

import pytest

from space_dist.errors import ConfigError, SpaceDistError
from space_dist.ledger import CURRICULUM, Ledger
from space_dist.run.building import Blueprint
from space_dist.run.launch import launch
from space_dist.system.interrupts import StopRequests
from tests.commanding import command
from tests.own_code import Example, example  # noqa: F401

EXAMPLE = Example(
    "your_curriculum.md", "my_curriculum", rounds=16,
    quick=("budget.steps=4096", "learner.n_steps=256", "learner.n_epochs=1", "evaluation.every_steps=4096",
           "checkpoint.every_rounds=1", "tracking.uri=null"),
)  # fmt: skip
chosen, trained = EXAMPLE.chosen, EXAMPLE.trained


def test_the_example_in_the_documentation_is_short_and_works(
    example: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert len((example / "my_curriculum.py").read_text().splitlines()) <= 45
    _, check, train = (line.partition("#")[0].split()[1:] for line in EXAMPLE.blocks("bash")[0].splitlines())
    capsys.readouterr()
    assert command(monkeypatch, *check) == 0
    assert "my_curriculum:Lagging: no fault found in 30 decisions on 12 instances" in capsys.readouterr().out
    quick = [part for setting in (*EXAMPLE.quick, "resources.workers=0") for part in ("--set", setting)]
    assert command(monkeypatch, *train, "--out", "run", *quick) == 0, capsys.readouterr().err
    rows = [row for row in Ledger(Path("run")).rows() if row["kind"] == "iteration"]
    assert {row["curriculum"]["size"] for row in rows if row["complete"]} == {3}  # a quarter of twelve
    played = [row["trained"] for row in Ledger(Path("run")).rows(CURRICULUM)]
    assert {len(one) for one in played} == {3}
    assert len({tuple(one) for one in played}) > 1
    assert rows[0]["curriculum"]["never_played"] > 0
    assert command(monkeypatch, "explain", "run", "--iteration", "1") == 2
    assert "custom chooses by rules of its own, so it has no lines 6 to 13" in capsys.readouterr().err


@pytest.mark.usefixtures("example")
def test_one_that_probes_nothing_counts_up_to_whole_updates() -> None:
    config = chosen('curriculum={kind: custom, import: "tests.faulty_curricula:Honest"}', "budget.steps=1000")
    blueprint = Blueprint.of(config)
    curriculum = blueprint.curriculum(*blueprint.instances())
    assert blueprint.reachable_steps(curriculum) == 768
    assert blueprint.total_steps == 1000  # by which learning rates fall, whatever it probes


@pytest.mark.ray
@pytest.mark.usefixtures("one_ray")
def test_neither_workers_nor_a_kill_change_a_byte(example: Path) -> None:
    reference = trained(example / "reference")
    for workers in (1, 2):
        assert trained(example / f"workers{workers}", workers=workers) == reference
    EXAMPLE.assert_a_kill_changes_no_byte(example, reference)


def test_seed_and_arguments_decide(example: Path) -> None:
    reference = trained(example / "reference")
    assert trained(example / "seed", "seed=1")[CURRICULUM] != reference[CURRICULUM]
    assert trained(example / "share", "curriculum.kwargs.share=0.5")[CURRICULUM] != reference[CURRICULUM]


def test_its_source_is_part_of_what_a_run_is(example: Path) -> None:
    EXAMPLE.assert_its_source_is_part_of_a_run(example)


def test_columns_of_the_instances_reach_it(example: Path) -> None:
    (example / "my_curriculum.py").write_text(
        (example / "my_curriculum.py").read_text().replace("-np.inf)", "-np.inf) + instances_columns(self)")
        + "\n\ndef instances_columns(self):\n    return 0.0 * self.instances.columns['effort']\n"
    )
    with pytest.raises(SpaceDistError, match="KeyError: 'effort'"):
        trained(example / "without")
    file = example / "pointmass/uniform_train.csv"
    header, *rows = file.read_text().splitlines()
    file.write_text("\n".join([f"{header},effort", *(f"{row},{number}" for number, row in enumerate(rows))]) + "\n")
    trained(example / "with", "curriculum.columns=[effort]")


@pytest.mark.parametrize(
    ("curriculum", "words"),
    [
        ('import: "faulty:Nobody"', "curriculum.import 'faulty:Nobody': cannot import 'faulty': ModuleNotFoundError"),
        ('import: "tests.faulty_curricula:Honnest"', "has no class 'Honnest'; did you mean 'Honest'?"),
        ('import: "tests.faulty_curricula:nothing"', "made a str, which is no curriculum"),
        ('import: "tests.faulty_curricula:WantsEnsemble"', "it wants the values of an ensemble"),
        ('import: "tests.faulty_curricula:Honest", kwargs: {size: 3}', "unexpected keyword argument 'size'"),
        (
            'import: "tests.faulty_curricula:Honest", columns: [nix]',
            "train.csv: row 1: there is no column 'nix', which curriculum.columns names. There are id, gate_x, ",
        ),
        ('import: "tests.faulty_curricula:Honest", columns: [gate_x]', "curriculum.columns: 'gate_x' is a feature"),
    ],
)
@pytest.mark.usefixtures("example")
def test_what_cannot_be_made_is_refused_before_the_run(curriculum: str, words: str) -> None:
    config = chosen(f"curriculum={{kind: custom, {curriculum}}}")
    blueprint = Blueprint.of(config)
    with pytest.raises(ConfigError) as refusal:
        blueprint.setup(*blueprint.instances())
    assert words in str(refusal.value)


@pytest.mark.parametrize(
    ("curriculum", "words"),
    [
        ("import: my_curriculum", "curriculum.import: must be an import path with a colon"),
        ('import: "json:loads"', "curriculum.import: 'json' is a module of Python's standard library"),
        ('import: "space_dist.curricula:RoundRobin"', "'space_dist.curricula' is a module of space_dist itself"),
        ("kwargs: {share: 1}", "curriculum.import: this key is required"),
        ('import: "a:B", import_path: "a:B"', "curriculum.import_path: unknown key; did you mean 'import'?"),
        (
            'import: "a:B", kwargs: {share: [1]}',
            "curriculum.kwargs.share: must be true or false, a number, or a text, not [1]",
        ),
        ('import: "a:B", kwargs: {share: }', "curriculum.kwargs.share: is empty; give it true or false, a number, or"),
    ],
)
@pytest.mark.usefixtures("example")
def test_what_a_config_may_not_say_is_refused(curriculum: str, words: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        chosen(f"curriculum={{kind: custom, {curriculum}}}")
    assert words in str(refusal.value)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("", "curriculum.kind: this key is required: a"),
        ("kind: mine, ", "curriculum.kind: 'mine' is not known: a"),
        ("kind: space, ", "curriculum.import: unknown key; a"),
    ],
)
@pytest.mark.usefixtures("example")
def test_import_without_its_kind_is_told_which_that_is(kind: str, words: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        chosen(f'curriculum={{{kind}import: "a:B"}}')
    assert str(refusal.value).endswith(f"{words} curriculum of your own, which import names, has `kind: custom`")


def test_an_answer_that_breaks_the_protocol_ends_the_run_with_a_sentence(example: Path) -> None:
    for name, words in (("StoresLists", "no checkpoint can store"), ("LogsArrays", "step() logs scores = an array")):
        config = chosen(f'curriculum={{kind: custom, import: "tests.faulty_curricula:{name}"}}', "budget.steps=1024")
        with pytest.raises(ConfigError, match=re.escape(words)):
            launch(config, example / name, resume=True, stop=StopRequests())
        status = Ledger(example / name).status()
        assert status.state == "failed"
        assert status.message is not None
        assert words in status.message


def test_what_it_raises_is_told_with_where(example: Path) -> None:
    config = chosen('curriculum={kind: custom, import: "tests.faulty_curricula:Raises"}', "budget.steps=1024")
    where = "KeyError: 'no such score' (in curriculum.import 'tests.faulty_curricula:Raises': step())"
    with pytest.raises(SpaceDistError, match=re.escape(f"the run failed: {where}. The traceback is in")):
        launch(config, example / "run", resume=True, stop=StopRequests())
    assert Ledger(example / "run").status().message == where
