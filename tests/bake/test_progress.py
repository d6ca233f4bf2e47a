"""What a long command says while it works."""

from __future__ import annotations

import json

from gi_volumes.bake.progress import Progress


def test_the_time_left_counts_only_the_work_of_this_run(capsys, monkeypatch):
    clock = iter([0.0, 0.0, 10.0, 20.0, 20.0])
    monkeypatch.setattr("gi_volumes.bake.progress.time.monotonic", lambda: next(clock))
    progress = Progress(as_json=True)
    progress.stage("Baking", 100, done=80)
    progress.show(85)
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(line["done"], line["seconds_left"]) for line in lines] == [(80, None), (85, 30.0)]


def test_a_long_stage_writes_a_line_into_a_log_now_and_then(capsys, monkeypatch):
    now = [0.0]
    monkeypatch.setattr("gi_volumes.bake.progress.time.monotonic", lambda: now[0])
    progress = Progress()
    progress.stage("Baking", 1000)
    for done in range(1, 1001):
        now[0] += 0.05
        progress.show(done)
    progress.show(1000)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "Baking:  20 %, 40 s left"
    assert len(lines) == 5
    assert lines[-1] == "Baking: 100 %"
