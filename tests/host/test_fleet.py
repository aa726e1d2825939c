"""Many arms: each writes its own result, a further run does what is missing, and workers do not change numbers."""

import csv
import json
import os
import shutil
import signal
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from threading import Thread

import numpy as np
import pytest
from identify_bench import SIGMA, exact_lengths

from truearm.estimate.result_file import FORMAT
from truearm.findings import Finding
from truearm.kinds.rig_file import write_rig
from truearm.kinds.table_file import read_table, write_table
from truearm.workflows.project_file import FILE, Project, format_project

ARMS = ("a", "b", "c")


@pytest.fixture
def cells(tmp_path):
    """Make three projects of a PUMA, measured with noise of their own."""
    table, rig = exact_lengths(90)
    for number, name in enumerate(ARMS):
        home = tmp_path / "cells" / name
        home.mkdir(parents=True)
        noise = np.random.default_rng(number).normal(0.0, SIGMA, len(table))
        write_table(home / "poses.csv", replace(table, value=table.value + noise), ("rad",) * 6)
        write_rig(home / "rig.toml", rig)
        (home / FILE).write_text(format_project(Project("puma560", serial=name, table="poses.csv")))
    return tmp_path / "cells"


def results(cells):
    return {name: list((cells / name / "results").glob("*.json")) for name in ARMS}


def parameters(cells):
    """The parameters of every arm, whose one result is whole."""
    documents = {name: json.loads(path.read_text()) for name, (path,) in results(cells).items()}
    assert {document["format"] for document in documents.values()} == {FORMAT}
    return {name: document["parameters"] for name, document in documents.items()}


def forget(cells):
    for paths in results(cells).values():
        for path in paths:
            path.unlink()


def test_the_numbers_do_not_depend_on_the_workers_and_dask_has_the_same(run, cells, tmp_path):
    table = tmp_path / "fleet.csv"
    assert run("fleet", cells, "--workers", 1, "--hold-out", "0.2", "--out", table).code == 0
    alone = parameters(cells)
    assert alone["a"] != alone["b"]
    rows = {Path(row["arm"]).name: row for row in csv.DictReader(table.open())}
    assert [rows[name]["serial"] for name in ARMS] == list(ARMS)
    assert all(float(row["after_mm"]) < float(row["before_mm"]) for row in rows.values())
    for arguments in (("--workers", 2), ("--dask", "local", "--workers", 2)):
        forget(cells)
        outcome = run("fleet", cells, "--hold-out", "0.2", "--out", table, *arguments)
        assert outcome.code == 0, outcome.err
        assert parameters(cells) == alone


def test_dask_is_used_by_address(run, cells):
    from distributed import LocalCluster

    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        assert run("fleet", cells, "--dask", cluster.scheduler_address).code == 0
        assert len(parameters(cells)) == 3
        assert run("fleet", cells, "--dask", cluster.scheduler_address, "--workers", 2).code == 2
    assert "no Dask scheduler" in run("fleet", cells, "--dask", "nothing://here").err
    begun = time.monotonic()
    assert "no Dask scheduler" in run("fleet", cells, "--dask", "tcp://127.0.0.1:1").err
    assert time.monotonic() - begun < 10.0


def test_a_further_run_does_what_is_missing(run, cells):
    assert run("fleet", cells, "--workers", 1).code == 0
    first = results(cells)
    first["b"][0].unlink()
    kept = {name: first[name] for name in ("a", "c")}
    assert run("fleet", cells, "--workers", 1, "--reports").code == 0
    second = results(cells)
    assert {name: second[name] for name in kept} == kept
    assert all(path.with_suffix(".html").exists() for paths in second.values() for path in paths)
    rig = cells / "c" / "rig.toml"
    rig.write_text(rig.read_text() + "\n# measured again\n")
    assert run("fleet", cells, "--workers", 1).code == 0
    assert [len(paths) for paths in results(cells).values()] == [1, 1, 2]


def test_a_page_states_once_what_was_noticed_while_reading(run, cells):
    poses = cells / "a" / "poses.csv"
    table = read_table(poses, ("rad",) * 6)
    write_table(poses, replace(table, time=np.arange(len(table))[::-1].astype(float)), ("rad",) * 6)
    assert run("fleet", cells, "--workers", 1, "--reports").code == 0
    (result,) = results(cells)["a"]
    text = Finding("rows-reordered", {"place": "poses.csv"}).text()
    assert result.with_suffix(".html").read_text("utf-8").count(text) == 1


def test_a_result_of_other_options_is_not_adopted(run, cells, monkeypatch):
    for name in ("b", "c"):
        shutil.rmtree(cells / name)
    monkeypatch.chdir(cells / "a")
    assert run("identify", "--free", "joint1.*", "--hold-out", "0.2").code == 0
    for _ in range(2):
        assert run("fleet", ".", "--workers", 1, "--hold-out", "0.2").code == 0
    assert len(results(cells)["a"]) == 2
    assert run("fleet", ".", "--workers", 1).code == 0
    assert len(results(cells)["a"]) == 3


def test_a_result_of_identify_is_adopted(run, cells, monkeypatch):
    monkeypatch.chdir(cells / "a")
    assert run("identify", "--hold-out", "0.2").code == 0
    assert run("fleet", ".", "--workers", 1, "--hold-out", "0.2").code == 0
    assert len(results(cells)["a"]) == 1


def test_the_worst_arm_is_the_exit_code(run, cells, tmp_path):
    (cells / "a" / "poses.csv").write_text("kind\n")
    (cells / "b" / "truearm.toml").write_text('model = "puma560"\n')  # nothing is recorded
    table = tmp_path / "fleet.csv"

    def rows_and_code():
        outcome = run("fleet", cells, "--workers", 1, "--json", "--out", table)
        rows = {Path(row["arm"]).name: row for row in json.loads(outcome.out)["arms"]}
        return rows, (outcome.code, *(rows[name]["code"] for name in ARMS))

    rows, codes = rows_and_code()
    assert codes == (2, 2, 2, 0)
    assert "truearm record" in rows["b"]["verdict"]
    assert results(cells)["c"]
    shutil.rmtree(cells / "b")
    shutil.copytree(cells / "c", cells / "b", ignore=shutil.ignore_patterns("results"))
    (cells / "b" / "results").write_text("a file")
    rows, codes = rows_and_code()
    assert codes == (1, 2, 1, 0)
    assert "results: File exists" in rows["b"]["verdict"]
    assert [row["code"] for row in csv.DictReader(table.open())] == ["2", "1", "0"]
    table.write_text("mine\n")
    assert run("fleet", cells, "--out", table).code == 2
    (tmp_path / "empty").mkdir()
    assert run("fleet", tmp_path / "empty").code == 2


def killed_worker(killed):
    """Kill the first worker of loky that this process starts, while it has work."""
    children = Path(f"/proc/{os.getpid()}/task")
    until = time.monotonic() + 60.0
    while not killed and time.monotonic() < until:
        for child in (int(pid) for path in children.glob("*/children") for pid in path.read_text().split()):
            with suppress(OSError):
                if b"popen_loky" in Path(f"/proc/{child}/cmdline").read_bytes():
                    os.kill(child, signal.SIGKILL)
                    killed.append(child)
                    return
        time.sleep(0.02)


def test_a_killed_worker_costs_a_second_run(run, cells):
    from joblib.externals.loky import get_reusable_executor

    get_reusable_executor().shutdown(wait=True)  # workers of earlier tests
    killed = []
    thread = Thread(target=killed_worker, args=(killed,))
    thread.start()
    outcome = run("fleet", cells, "--workers", 2)
    thread.join()
    assert killed
    assert outcome.code == 0, outcome.out
    assert all(len(paths) == 1 for paths in results(cells).values())
    assert len(parameters(cells)) == 3
