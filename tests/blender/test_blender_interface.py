"""The add-on in Blender's interface: progress, Esc, the panel and the options, with stand-ins for Blender's windows."""

import pytest
from blender_session import needs_blender, run_in_blender

from mapctl.commands.blender_addon import build_addon_zip

pytestmark = needs_blender


@pytest.fixture(scope="module")
def facts(tmp_path_factory) -> dict:
    """Facts noted in Blender."""
    folder = tmp_path_factory.mktemp("interface")
    (folder / "addon.zip").write_bytes(build_addon_zip())
    return run_in_blender("play_interface.py", folder)[0]


def test_buttons_are_grey_while_a_job_runs(facts):
    assert facts["poll while one runs"] is False


def test_progress_is_shown(facts):
    assert {"reading the action 8 %", "cleaning up", "walking 25 %"} <= set(facts["steps"])
    assert facts["panel while it runs"][-2:] == ["walking 25 %", "Esc to cancel"]


def test_only_the_view_can_be_used_while_a_job_runs(facts):
    assert facts["keys are held"] == ["RUNNING_MODAL"]
    assert facts["view is free"] == ["PASS_THROUGH"]


def test_esc_ends_the_process_and_leaves_no_trace(facts):
    cancelled = facts["cancelled"]
    assert cancelled["notes"] == ["begin", "handler", "timer", "end", None]
    assert cancelled["printed"] == ["cancelled: nothing was changed"]
    assert [cancelled[name] for name in ("ended", "folder", "unchanged", "step")] == [True, False, True, True]


def test_jobs_end_by_themselves_in_the_interface(facts):
    answer, printed, notes = facts["modal end"]
    assert answer == ["FINISHED"]
    assert printed == [[["INFO"], "new action: mixamoAction clean"]]
    assert notes == ["timer", "end", None]
    assert facts["modal failure"] == [["CANCELLED"], [[["ERROR"], "nobody walks here"]]]


def test_panel_has_every_operator(facts):
    operators = [f"mapctl.{name}" for name in ("walk", "clean_up", "fill_gap", "in_between")]
    assert [name for name in facts["panel"] if name.startswith("mapctl.")] == operators


def test_blender_accepts_the_manifest(facts):
    assert "Success" in facts["manifest"]
    assert "ERROR" not in facts["manifest"]


def test_addon_goes_and_comes(facts):
    assert facts["gone"]
    assert facts["back"]
