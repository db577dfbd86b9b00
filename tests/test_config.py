from pathlib import Path

import pytest

from segslam.config import Config, config_from_yaml, config_to_yaml, load_config
from segslam.types import Label, SegslamError


def test_the_effective_settings_read_back_equal() -> None:
    config = load_config(None, ["keyframes.distance_m=3.5", "segregator.cluster_min_points={car: 20, pole: 5}"])
    assert config.segregator.cluster_min_points == {Label.CAR: 20, Label.POLE: 5}
    assert config_from_yaml(config_to_yaml(config), "test") == config


def test_settings_of_an_older_version_are_read_without_those_that_have_gone(caplog: pytest.LogCaptureFixture) -> None:
    text = config_to_yaml(load_config(None, ["keyframes.distance_m=3.5"]))
    older = text.replace("keyframes:\n", "keyframes:\n  shape: round\n") + "weather:\n  rain: true\n"
    assert config_from_yaml(older, "log.mcap") == config_from_yaml(text, "test")
    assert [record.getMessage() for record in caplog.records] == [
        "log.mcap: left out what this version does not have: keyframes.shape, weather"
    ]
    with pytest.raises(SegslamError, match=r"log\.mcap: keyframes\.distance_m: .* got -1"):
        config_from_yaml("keyframes: {distance_m: -1}", "log.mcap")


def test_a_file_holds_differences_and_set_wins_over_it(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("keyframes: {distance_m: 4.0, angle_deg: 30}\n")
    config = load_config(file, ["keyframes.distance_m=5"])
    assert (config.keyframes.distance_m, config.keyframes.angle_deg) == (5.0, 30.0)
    assert config.refine == Config().refine


@pytest.mark.parametrize("file", sorted((Path(__file__).parents[1] / "configs").glob("*.yaml")), ids=lambda f: f.name)
def test_shipped_configurations_load(file: Path) -> None:
    assert load_config(file) != Config(), "a configuration that changes nothing"


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("keyframes.distance=1", "keyframes.distance"),
        ("keyframe.distance_m=1", "keyframe"),
        ("keyframes.distance_m=-1", "keyframes.distance_m"),
        ("keyframes.distance_m=[", "--set keyframes.distance_m"),
        ("segregator.feature_classes=[hovercraft]", "feature_classes"),
        ("distance_m=1", "section.key=value"),
        ("keyframes.distance_m", "section.key=value"),
    ],
)
def test_a_wrong_setting_is_refused_by_name(text: str, named: str) -> None:
    with pytest.raises(SegslamError, match=named.replace(".", r"\.").replace("[", r"\[")):
        load_config(None, [text])


@pytest.mark.parametrize("content", [b"keyframes: [", b"- a\n- b\n", b"keyframes: 3\n", b"\xff\xfe\x00", None])
def test_a_file_that_holds_no_settings_is_refused_by_name(tmp_path: Path, content: bytes | None) -> None:
    file = tmp_path / "broken.yaml"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(SegslamError, match=r"broken\.yaml"):
        load_config(file, ["keyframes.distance_m=2"])


def test_an_empty_file_means_the_defaults(tmp_path: Path) -> None:
    (tmp_path / "empty.yaml").write_text("")
    assert load_config(tmp_path / "empty.yaml") == Config()
