"""Processor, memory and GPU."""

import os
import shutil

import torch

from completesplat.reports.doctor.finding import Finding, size
from completesplat.reports.machine import machine

PART = "device"


def check() -> list[Finding]:
    """A GPU that is not there is no error: small models draw in seconds without."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    found = [Finding(PART, "processor", "yes", f"{machine()['processor']}, {cores} cores to use")]
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        found.append(Finding(PART, "memory", "yes", size(memory)))
    if not torch.cuda.is_available():
        return [*found, Finding(PART, "GPU", "no", no_gpu())]
    for index in range(torch.cuda.device_count()):
        free, total = torch.cuda.mem_get_info(index)
        said = f"{torch.cuda.get_device_name(index)}, {size(free)} of {size(total)} free"
        found.append(Finding(PART, f"GPU {index}", "yes", said))
    return found


def no_gpu() -> str:
    """Why torch sees none."""
    if torch.version.cuda is None:
        return f"this torch ({torch.__version__}) is built without CUDA; all works on the processor, slower"
    if shutil.which("nvidia-smi") is None:
        return "no NVIDIA driver here (there is no nvidia-smi); all works on the processor, slower"
    return f"torch for CUDA {torch.version.cuda} finds none; `nvidia-smi` says what the driver sees"
