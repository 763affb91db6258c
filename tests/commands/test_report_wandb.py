from completesplat.reports.dashboard.panels import PANELS


def test_the_layout_names_every_panel_with_its_section(command, tmp_path):
    finished = command("report", "wandb", f"out={tmp_path}")
    assert finished.status == 0, finished.err
    for panel in PANELS:
        assert panel.section in finished.out
        assert f" {panel.keys} " in finished.out
