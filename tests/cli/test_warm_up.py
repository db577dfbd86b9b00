import pytest

from segslam import cli
from segslam.core import kernels


def _warm_up() -> int:
    with pytest.raises(SystemExit) as ended:
        cli.main(["warm-up"])
    return int(ended.value.code or 0)


def test_it_compiles_each_kernel_and_reports_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(kernels, "are_built", lambda: False)
    monkeypatch.setattr(kernels, "build", lambda: iter(["a"] * kernels.num_kernels()))
    assert _warm_up() == 0
    assert f"{kernels.num_kernels()} kernels were compiled" in capsys.readouterr().err


def test_it_reports_when_all_kernels_are_compiled(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(kernels, "are_built", lambda: True)
    assert _warm_up() == 0
    assert "all kernels are compiled" in capsys.readouterr().err


def test_a_build_that_fails_is_a_warning_only(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def build() -> None:
        raise RuntimeError("the kernels were not compiled: no memory")

    monkeypatch.setattr(kernels, "are_built", lambda: False)
    monkeypatch.setattr(kernels, "build", build)
    assert _warm_up() == 0
    assert "no memory" in caplog.text
