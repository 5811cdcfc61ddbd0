"""Every fault of a curriculum is found, and said in the right words; what is without fault passes."""

from __future__ import annotations

from pathlib import Path

import pytest

from space_dist.curricula.checker import DECISIONS, check
from space_dist.errors import ConfigError
from space_dist.instances import InstanceSet, read_features
from tests.commanding import command
from tests.two_features import BOUNDS, scattered

FAULTS = {
    "Unseeded": "two new objects, given the same state and feedback, give another state.scores each (decision 1)",
    "GlobalGenerator": "two new objects, given the same state and feedback, give another state.scores each",
    "UnseededStart": "start() is not a function of instances and seed: asked again, it gives another selection.ids",
    "CountsGlobally": "two new objects, given the same state and feedback, give another state.scores each",
    "Remembers": "the object remembers something that is not in its state: it gives another state.scores",
    "KeepsItsGenerator": "the object remembers something that is not in its state",
    "NeedsItsStart": "of an object that made no decision before, fails: AttributeError",
    "ChangesState": "step() changes state.scores, which it was given, in place",
    "ChangesFeedback": "step() changes feedback.values_after, which it was given, in place",
    "ProbesAtRandom": "probes() is not a function of state and episodes",
    "StoresLists": "Listed.scores is a list, which no checkpoint can store: a state's fields are int, float, bool",
    "StoresObjects": "Listed.scores is an array of dtype object and shape (2,), which no checkpoint can store",
    "StoresNumpyNumbers": "Listed.scores is a NumPy number (int64; int(), float() or bool() make it plain)",
    "StoresBesideItsFields": "the state does not survive storing: as a checkpoint gives it back, it leads to another "
    "numbers['hidden']",
    "CannotBeRestored": "Refuses.fresh cannot be restored from a checkpoint",
    "NoDataclass": "Undecorated is no dataclass: write @dataclass(frozen=True) above it",
    "NoStateType": "its `state_type` must be a dataclass derived from space_dist.curricula.State",
    "OtherState": "start() returned a State for a state; its state_type is Scores",
    "ForgetsToCount": "step() returned a state of version 0, not 1: versions count decisions",
    "Empty": "start() selects nothing: there must be an instance to train on",
    "IndicesForIds": "which is none of the set's 40, whose ids go from 10 to 49",
    "OtherContexts": "with another context than its own",
    "SortsIds": "with another context than its own",
    "SameOrder": "step() selects other instances under the same order_version",
    "SelectsOtherwise": "selection() of a state gives another selection.ids than start() or step() returned with it",
    "FewDraws": "start() draws 5 times; a round can use 64 (draws.count)",
    "OutOfBounds": "start() generates a context with a = 10",
    "GeneratesASet": "generates contexts (id -1) that are not drawn: set Selection(drawn=True)",
    "NoSelection": "start() returned a ndarray for a selection",
    "TwoAnswers": "step() must return (state, selection, numbers for the log)",
    "ProbesNothing": "None where nothing shall be probed; it returned an array of dtype int64 and shape (0,)",
    "ProbesOutside": "probes() asks for index 40; the set has indices 0 to 39",
    "WantsEnsemble": "it wants the values of an ensemble, which is trained for curriculum.kind: vds alone",
    "WantsAdvantages": "it wants advantages, which are told by episode, and no episodes",
    "WantsNegatives": "has advantage_part 'postive'; did you mean 'positive'? Allowed: size, positive",
    "WantsSuccess": "it wants success, which is told by episode, and no episodes",
    "LearnsNot": "start() selects what shall not be learned from; say so before: set Wants(unlearned=True)",
    "WantsInWords": "its `wants` must be a space_dist.curricula.Wants, not a tuple",
    "LogsNaN": "step() logs mean_return = nan, which is no number: log None where there is none",
    "LogsArrays": "step() logs scores = an array of dtype float64",
    "ForgetsToAsk": "feedback.episodes is None, for the class does not say that it wants them: "
    "wants = Wants(episodes=True)",
    "NeedsEpisodes": "step() where no episode ended fails: ValueError",
    "Unmakeable": "cannot be made: KeyError: 'no such setting'",
    "nothing": "made a str, which is no curriculum: derive its class from space_dist.curricula.Curriculum",
    "Scores": "is no curriculum: derive it from space_dist.curricula.Curriculum; 'tests.faulty_curricula' has Honest, ",
    "number": "'tests.faulty_curricula' has no class 'number'",
    "nobody": "'tests.faulty_curricula' has no class 'nobody'",
}


def instances(n: int = 40) -> InstanceSet:
    return scattered(n, first_id=10)


@pytest.mark.parametrize("kind", FAULTS)
def test_a_curriculums_fault_is_named(kind: str) -> None:
    (fault,) = check(f"tests.faulty_curricula:{kind}", instances(), BOUNDS).faults
    assert FAULTS[kind] in fault, fault


@pytest.mark.parametrize(
    "kind",
    ["Honest", "Drawing", "Generates", "NeedsSuccess", "ReadsSuccess", "Copes", "NeverChanges", "LooksFirst"],
)
def test_without_fault(kind: str) -> None:
    findings = check(f"tests.faulty_curricula:{kind}", instances(), BOUNDS)
    assert findings.faults == []
    notes = {
        "NeedsSuccess": [
            "ValueError: did it succeed?; if it has to know, say Wants(success=True), and other environments"
        ],
        "ReadsSuccess": [
            "it reads the success of episodes without Wants(success=True): where the environment does not say whether "
            "an episode succeeded, state.scores becomes NaN; if it has to know, say so"
        ],
        "NeverChanges": ["in 30 decisions it selected the same instances", "its order_version changes"],
    }.get(kind, [])
    assert len(findings.notes) == len(notes)
    assert all(words in note for words, note in zip(notes, findings.notes, strict=True)), findings.notes


def test_arguments_are_passed_on_and_those_of_the_run_are_not_the_configs() -> None:
    path = "tests.faulty_curricula:Honest"
    assert check(path, instances(), BOUNDS, {"share": 1.0}).faults == []
    (fault,) = check(path, instances(), BOUNDS, {"sahre": 1.0}).faults
    assert "cannot be made of the instances and curriculum.kwargs: got an unexpected keyword argument 'sahre'" in fault
    assert fault.endswith("'sahre'; did you mean 'share'? Its own are: share")
    (fault,) = check(path, instances(), BOUNDS, {"seed": 1}).faults
    assert "curriculum.kwargs: 'seed' comes from the run" in fault
    (fault,) = check(path, instances(), BOUNDS, {"instances": 1}).faults
    assert "curriculum.kwargs: 'instances' comes from the run" in fault
    (fault,) = check(path, instances(), BOUNDS, {"share": "much"}).faults
    assert "cannot be made of the instances and curriculum.kwargs: TypeError: " in fault


def test_a_word_without_a_colon_is_told_what_a_curriculums_import_path_is() -> None:
    (fault,) = check("tests.two_features.Nobody", instances(), BOUNDS).faults
    assert fault.endswith("'tests.two_features.Nobody': an import path has a colon: tests.two_features:Generator or "
                          "tests.two_features:scattered")  # fmt: skip
    (fault,) = check("space", instances(), BOUNDS).faults
    assert fault == "curriculum.import 'space': an import path has a colon, like my_package.my_module:MyCurriculum"


def test_it_takes_two_instances() -> None:
    with pytest.raises(ConfigError, match="at least two instances"):
        check("tests.faulty_curricula:Honest", instances(1), BOUNDS)


def test_a_file_is_read_without_its_environment(tmp_path: Path) -> None:
    path = tmp_path / "some.csv"
    path.write_text('\ufeffid,"gain",effort,drift\n3,1.0,7,-0.5\n1,1.0,8,0.5\n')
    found, bounds = read_features(path, ["effort"])
    assert (found.ids.tolist(), found.names, found.columns["effort"].tolist()) == ([1, 3], ("gain", "drift"), [8, 7])
    assert (bounds.low.tolist(), bounds.high.tolist()) == ([1.0, -0.5], [2.0, 0.5])
    for content, words in (("id\n1\n", "row 1 names no feature"), ("id,a,a\n1,2,3\n", "'a' is named twice"),
                           ("", "is empty"), ("id,a\n1,x\n", "row 2, column 'a': 'x' is not a number")):  # fmt: skip
        path.write_text(content)
        with pytest.raises(ConfigError, match=words) as caught:
            read_features(path)
        assert str(caught.value).startswith(str(path))
    path.write_text("id,a\n1,2\n")
    with pytest.raises(
        ConfigError, match=r"some\.csv: row 1: there is no column 'b', which --column names\. There are"
    ):
        read_features(path, ["b"], named_by="--column")
    with pytest.raises(ConfigError, match=r"nowhere\.csv: there is no such file"):
        read_features(tmp_path / "nowhere.csv")
    assert read_features("shipped:instances/cartpole_train.csv")[0].names == ("length",)


def test_the_command_says_what_is_wrong(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = tmp_path / "train.csv"
    file.write_text(instances().to_csv())
    ask = ("curriculum", "check", "--instances", file)
    assert command(monkeypatch, *ask, "tests.faulty_curricula:NeverChanges", "--kwarg", "share=0.3") == 0
    said = capsys.readouterr().out
    assert "note: in 30 decisions" in said
    assert f"tests.faulty_curricula:NeverChanges: no fault found in {DECISIONS} decisions on 40 instances" in said
    assert command(monkeypatch, *ask, "tests.faulty_curricula:Remembers") == 2
    assert "space-dist: tests.faulty_curricula:Remembers: the object remembers" in capsys.readouterr().err
    assert command(monkeypatch, *ask, "os:system") == 2
    assert "'os' is a module of Python's standard library" in capsys.readouterr().err
    assert command(monkeypatch, *ask, "space_dist.curricula:RoundRobin") == 2
    assert "'space_dist.curricula' is a module of space_dist itself" in capsys.readouterr().err
