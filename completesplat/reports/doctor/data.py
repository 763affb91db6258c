"""The data sets of the configuration, as far as they lie where it says."""

from pathlib import Path

from omegaconf import OmegaConf

from completesplat.reports.doctor.finding import Finding

PART = "data"


def check(conf: Path, place: Path) -> list[Finding]:
    """Data are needed to train, not to complete a photograph.

    Args:
        conf: the folder of the data sets' configurations.
        place: the folder that relative roots start from.
    """
    found = []
    for path in sorted(conf.glob("*.yaml")):
        config = OmegaConf.to_container(OmegaConf.load(path))
        # One without a root of its own has another one's, or cannot be chosen.
        if isinstance(config, dict) and "root" in config:
            found.append(_data_set(path.stem, str(config["root"]), "data_seed" in config, place))
    return found


def _data_set(name: str, root: str, procedural: bool, place: Path) -> Finding:
    if root == "???":
        return Finding(PART, name, "no", f"has no place of its own: data={name} data.root=FOLDER")
    folder = place / root
    if folder.is_dir():
        return Finding(PART, name, "yes", f"{root}: {sum(1 for _ in folder.iterdir())} entries")
    said = "made there when it is first used" if procedural else f"data={name} data.root=FOLDER names another place"
    return Finding(PART, name, "no", f"not in {root}; {said}")
