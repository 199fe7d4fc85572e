"""A report is shown in a browser only where somebody sits in front of one, and wants it."""

from __future__ import annotations

import sys
import webbrowser
from pathlib import Path

import pytest
from typer.testing import CliRunner

from mrstrain.cli import browser, studies
from mrstrain.cli.app import app

VARIABLES = ("DISPLAY", "WAYLAND_DISPLAY", "SSH_CONNECTION", "CI")


@pytest.mark.parametrize(
    ("platform", "terminal", "given", "opens"),
    [
        ("linux", True, {"DISPLAY": ":0"}, True),
        ("linux", True, {"WAYLAND_DISPLAY": "wayland-0"}, True),
        ("linux", True, {"DISPLAY": ":0", "CI": "true"}, False),
        ("linux", False, {"DISPLAY": ":0"}, False),  # a pipe
        ("linux", True, {}, False),
        ("linux", True, {"SSH_CONNECTION": "10.0.0.1 1 10.0.0.2 22"}, False),
        ("darwin", True, {}, True),
        ("darwin", True, {"SSH_CONNECTION": "10.0.0.1 1 10.0.0.2 22"}, False),
        ("win32", True, {}, True),
        ("win32", False, {}, False),
    ],
)
def test_it_opens_in_a_terminal_beside_a_display(
    monkeypatch: pytest.MonkeyPatch, platform: str, terminal: bool, given: dict[str, str], opens: bool
) -> None:
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(browser.sys, "platform", platform)
    monkeypatch.setattr(sys.stdout, "isatty", lambda: terminal, raising=False)
    assert browser.can_open() is opens


def test_a_browser_gets_the_address_of_the_page_and_one_in_the_terminal_is_left_alone(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    opened: list[str] = []
    for kind, expected in ((webbrowser.BackgroundBrowser, 1), (webbrowser.GenericBrowser, 0)):
        opened.clear()
        monkeypatch.setattr(kind, "open", lambda _, url: opened.append(url))
        monkeypatch.setattr(webbrowser, "get", lambda kind=kind: kind("some-browser"))
        browser.show(tmp_path / "the report.html")
        assert opened == [(tmp_path / "the report.html").as_uri()] * expected

    def none() -> None:
        raise webbrowser.Error("could not locate runnable browser")

    monkeypatch.setattr(webbrowser, "get", none)
    browser.show(tmp_path / "report.html")


@pytest.mark.parametrize(
    ("options", "environment", "opens"),
    [([], {}, True), (["--no-open"], {}, False), ([], {"MRSTRAIN_NO_OPEN": "1"}, False)],
)
@pytest.mark.parametrize("command", ["run", "demo"])
def test_it_can_be_told_not_to(
    monkeypatch: pytest.MonkeyPatch, command: str, options: list[str], environment: dict[str, str], opens: bool
) -> None:
    given: list[object] = []
    monkeypatch.setattr(studies, "can_open", lambda: True)
    monkeypatch.setattr(studies, "_carry_out", lambda *_, on_report, **__: given.append(on_report))
    told = CliRunner().invoke(app, [command, *(["."] if command == "run" else []), *options], env=environment)
    assert told.exit_code == 0, told.output
    assert given == [browser.show if opens else None]
