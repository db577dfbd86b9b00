import re
from pathlib import Path

import pytest

from segslam.core.config import USER_SETTINGS, Config, config_from_yaml, config_to_yaml, load_config, parse_yaml
from segslam.core.types import Label, SegslamError


def test_the_effective_settings_read_back_equal() -> None:
    config = load_config(None, ["keyframes.distance_m=3.5", "segregator.cluster_min_points={car: 20, pole: 5}"])
    assert config.segregator.cluster_min_points == {Label.CAR: 20, Label.POLE: 5}
    assert config_from_yaml(config_to_yaml(config), "test") == config


def test_settings_of_an_older_version_are_read_without_removed_ones(caplog: pytest.LogCaptureFixture) -> None:
    text = config_to_yaml(load_config(None, ["keyframes.distance_m=3.5"]))
    older = text.replace("keyframes:\n", "keyframes:\n  shape: round\n") + "weather:\n  rain: true\n"
    assert config_from_yaml(older, "log.mcap") == config_from_yaml(text, "test")
    assert [record.getMessage() for record in caplog.records] == [
        "log.mcap: ignored settings that this version does not have: keyframes.shape, weather"
    ]
    with pytest.raises(SegslamError, match=r"log\.mcap: keyframes\.distance_m: .* got -1"):
        config_from_yaml("keyframes: {distance_m: -1}", "log.mcap")


def test_a_setting_that_was_removed_is_dropped_with_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file = tmp_path / "config.yaml"
    file.write_text("graph: {systematic_drift: never, odometry_sigma_m: 0.4}\n")
    config = load_config(file)
    assert config == load_config(None, ["graph.odometry_sigma_m=0.4"])
    assert [record.getMessage() for record in caplog.records] == [
        f"{file}: graph.systematic_drift no longer exists and is ignored"
    ]
    caplog.clear()
    assert load_config(None, ["graph.systematic_drift=auto", "geometric.max_things=9"]) == Config()
    assert [record.getMessage() for record in caplog.records] == [
        "--set: geometric.max_things, graph.systematic_drift no longer exist and are ignored"
    ]
    assert config_from_yaml(file.read_text(), "log.mcap") == config


def test_a_file_holds_differences_and_set_wins_over_it(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("keyframes: {distance_m: 4.0, voxel_m: 0.3}\n")
    config = load_config(file, ["keyframes.distance_m=5"])
    assert (config.keyframes.distance_m, config.keyframes.voxel_m) == (5.0, 0.3)
    assert config.refine == Config().refine


@pytest.mark.parametrize("file", sorted((Path(__file__).parents[2] / "configs").glob("*.yaml")), ids=lambda f: f.name)
def test_shipped_configurations_load(file: Path) -> None:
    assert load_config(file) != Config(), "a configuration that changes nothing"


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("keyframes.distance=1", "keyframes.distance"),
        ("keyframe.distance_m=1", "keyframe"),
        ("keyframes.distance_m=-1", "keyframes.distance_m"),
        ("keyframes.distance_m=.inf", "keyframes.distance_m"),
        ("keyframes.distance_m=.nan", "keyframes.distance_m"),
        ("odometry.max_range_m=1", "odometry: max_range_m 1 must be above min_range_m 3"),
        ("keyframes.distance_m=[", "--set keyframes.distance_m"),
        ("refine.correspondence_m=[]", "refine.correspondence_m"),
        ("refine.correspondence_m=[1.0, -0.5]", "refine.correspondence_m.1"),
        ("segregator.foot_classes=[hovercraft]", "foot_classes"),
        ("distance_m=1", "section.key=value"),
        ("keyframes.distance_m", "section.key=value"),
    ],
)
def test_a_wrong_setting_is_refused_by_name(text: str, named: str) -> None:
    with pytest.raises(SegslamError, match=named.replace(".", r"\.").replace("[", r"\[")):
        load_config(None, [text])


@pytest.mark.parametrize(
    "text", ["keyframes: {distance_m: 1, distance_m: 5}", "graph: {}\nkeyframes: {}\nkeyframes: {}\n"]
)
def test_a_key_given_twice_is_refused_with_its_line(tmp_path: Path, text: str) -> None:
    file = tmp_path / "twice.yaml"
    file.write_text(text)
    with pytest.raises(SegslamError, match=r"twice\.yaml: .* is given twice .*line \d"):
        load_config(file)


@pytest.mark.parametrize("content", [b"keyframes: [", b"- a\n- b\n", b"keyframes: 3\n", b"\xff\xfe\x00", None])
def test_a_file_that_holds_no_settings_is_refused_by_name(tmp_path: Path, content: bytes | None) -> None:
    file = tmp_path / "broken.yaml"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(SegslamError, match=r"broken\.yaml"):
        load_config(file, ["keyframes.distance_m=2"])


@pytest.mark.parametrize("text", ["", "verify:\n  # max_false_share: 0.01\n"])
def test_an_empty_file_or_section_means_the_defaults(tmp_path: Path, text: str) -> None:
    (tmp_path / "empty.yaml").write_text(text)
    assert load_config(tmp_path / "empty.yaml") == Config()
    assert load_config(tmp_path / "empty.yaml", ["verify.max_false_share=0.1"]).verify.max_false_share == 0.1


def test_settings_that_users_need_are_the_first_of_their_sections_and_every_default_has_a_source() -> None:
    wanted = [tuple(key.split(".")) for key in USER_SETTINGS]
    for section, field in Config.model_fields.items():
        fields = type(field.default).model_fields
        first = [key for name, key in wanted if name == section]
        assert list(fields)[: len(first)] == first, section
        for key, setting in fields.items():
            assert re.search(r"\[[^\]]+\]$", setting.description or ""), f"{section}.{key}"
    assert len(wanted) <= 16


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("{[a]: b}", "a key must be a name"),
        ("a: 0x_", "not valid YAML"),
        ("a: 2001-99-99", "not valid YAML"),
        ("[" * 3000, "nested too deeply in .*column 101"),
        ("- " * 3000, "nested too deeply"),
        ("a: &a [x]\nodometry: {max_range_m: *a}", r"\*a: write the value itself"),
        (f"odometry: {{max_range_m: {'x' * 5000}}}", r"odometry\.max_range_m: .* got 'x{79}\.\.\.$"),
        (f"odometry: {{max_range_m: 0x{'f' * 9000}}}", r"odometry\.max_range_m: .* got a int with too many digits"),
        (f"odometry: {{{'k' * 500}: 1}}", "unknown key odometry.k+"),
        ("verify: 3", "verify: expected a section with keys, found 3$"),
        ("3", "expected sections with keys, found 3$"),
    ],
)
def test_yaml_that_is_no_settings_is_refused_in_one_short_line(tmp_path: Path, text: str, complaint: str) -> None:
    file = tmp_path / "a.yaml"
    file.write_text(text)
    with pytest.raises(SegslamError, match=complaint) as refused:
        load_config(file)
    assert str(refused.value).startswith(f"{file}: ")
    assert len(str(refused.value)) < len(str(file)) + 1000
    assert "\n" not in str(refused.value)


def test_texts_of_digits_are_no_numbers_in_base_60_or_8() -> None:
    assert parse_yaml("[10:30, 1:50:2, 010, 07, 7, -3, 0, 0x1f]", "a") == ["10:30", "1:50:2", "010", "07", 7, -3, 0, 31]


@pytest.mark.parametrize("value", ["{[a]: b}", "0x_", "2001-99-99", "[" * 2000, "*a", "x" * 5000])
def test_a_value_of_set_that_is_no_yaml_is_refused_in_one_short_line(value: str) -> None:
    with pytest.raises(SegslamError) as refused:
        load_config(None, [f"odometry.max_range_m={value}"])
    assert "odometry.max_range_m" in str(refused.value)
    assert len(str(refused.value)) < 1000


def test_one_setting_may_be_given_alone() -> None:
    assert load_config(None, "graph.final=gnc") == load_config(None, ["graph.final=gnc"])


def test_a_path_may_be_text(tmp_path: Path) -> None:
    file = tmp_path / "one.yaml"
    file.write_text("keyframes: {distance_m: 3.0}")
    assert load_config(str(file)).keyframes.distance_m == 3.0
