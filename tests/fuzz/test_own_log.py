"""Our own log, damaged on purpose; damage at random is in the tests of all readers."""

import random
from pathlib import Path

import pytest
from helpers.made_logs import made_steps, write_log

from fuzz.children import defects
from fuzz.own_log import Read, odd, write_whole
from segslam.core.types import SegslamError
from segslam.output.log import read_log

NUM_CUTS = 60


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_whole(tmp_path_factory.mktemp("log") / "log.mcap")


def test_a_cut_anywhere_gives_the_steps_before_it(tmp_path: Path) -> None:
    short = write_log(tmp_path / "short.mcap", list(made_steps(6)))
    data, whole = short.read_bytes(), Read(read_log(short))
    cuts = [data[:size] for size in random.Random(0).sample(range(len(data)), NUM_CUTS)]
    found = defects(lambda file: Read(read_log(file)).check_part_of(whole), tmp_path / "log.mcap", cuts)
    assert not found, {defect.kind for defect in found}


def test_a_log_that_lacks_a_step_or_has_another_one_is_no_part_of_the_whole(log: Path, tmp_path: Path) -> None:
    whole = Read(read_log(log))
    whole.check_part_of(whole)
    for steps in (list(made_steps(26))[:-1], list(made_steps(26, seed=1))):
        with pytest.raises(AssertionError):
            Read(read_log(write_log(tmp_path / "log.mcap", steps))).check_part_of(whole)


def test_odd_logs_pass_the_checksums_and_differ_from_the_whole(log: Path, tmp_path: Path) -> None:
    """Most are read or refused for what is in them: a reader that refused all of them would not be tested."""
    path, outcomes = tmp_path / "log.mcap", []
    for seed in range(20):
        path.write_bytes(odd(random.Random(seed), log))
        try:
            read_log(path)
        except SegslamError as error:
            outcomes.append(str(error))
        else:
            outcomes.append("")
    assert not any("checksum" in outcome for outcome in outcomes)
    assert outcomes.count("") > 10


def test_an_index_with_the_correct_checksum_and_wrong_places_is_not_followed(log: Path, tmp_path: Path) -> None:
    """A damaged checksum of the settings refuses the log; a damaged index costs time only."""
    data = bytearray(log.read_bytes())
    data[-40] ^= 1
    path = tmp_path / "log.mcap"
    path.write_bytes(data)
    assert read_log(path).result() is not None
    setting = data.index(b"max_false_share")
    data[setting + 14] ^= 1
    path.write_bytes(data)
    with pytest.raises(SegslamError, match=r"log\.mcap: the settings at its start are damaged"):
        read_log(path)
