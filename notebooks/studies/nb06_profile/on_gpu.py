"""What one GPU takes for a closure of stage 3: the row that this project's machines cannot fill.

    python -m studies.nb06_profile.on_gpu        # from notebooks/; needs CUDA, writes results/long/gpu.json

Notebook 06 shows the file where it is. Times are wall times between two synchronisations; a GPU runs beside its host,
so that processor time says nothing.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import torch

from data_synth import clips
from motionlab import files
from studies.nb06_profile.program import alone
from studies.shared import profiling
from studies.shared.savings import FORMS
from studies.shared.workload import Part, random_priors, workload

FILE = Path(__file__).parents[2] / "results" / "long" / "gpu.json"
COMMAND = "python -m studies.nb06_profile.on_gpu"
_FRAMES, _ROUNDS = 60, 9


def measure(device: str = "cuda", batches: Sequence[int] = (1, 4, 8)) -> dict[str, object]:
    """Measures milliseconds and MiB of a closure of each form and batch, and the roll-out's share of one.

    allocated: most bytes of tensors. used: most bytes of the card that were taken, with what the allocator keeps and
    the context, which decides how many clips fit.
    """
    generator, rows, cause = torch.Generator().manual_seed(0), [], None
    walk, priors = clips.draw(1, generator, actions=("walk",))[0].motion.cut(0, _FRAMES), random_priors(generator)
    for batch in batches:
        work = workload(walk, priors, generator, batch).to(device)
        calls = {form: work.closure(Part(3, _FRAMES), on) for form, on in FORMS.items()}
        seconds = profiling.interleaved(calls, n=_ROUNDS)
        for form, call in calls.items():
            row = {"form": form, "clips": batch, "ms": 1e3 * seconds[form].median().item(), "n": _ROUNDS}
            rows.append(row | (_memory(call) if device == "cuda" else {}))
        if batch == 1:
            took = profiling.interleaved(alone(work), n=_ROUNDS)
            cause = 100 * (took["roll-out"] / took["whole closure"]).median().item()
    name = torch.cuda.get_device_name() if device == "cuda" else device
    found = {"device": name, "torch": torch.__version__, "frames": _FRAMES, "roll-out's share of the closure, %": cause}
    return found | {"rows": rows}


def _memory(call) -> dict[str, float]:
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    call()
    torch.cuda.synchronize()
    free, whole = torch.cuda.mem_get_info()
    return {"allocated": torch.cuda.max_memory_allocated() / 2**20, "used": (whole - free) / 2**20}


def rows(path: Path = FILE) -> list[dict[str, object]]:
    """Lists what was measured on a GPU, for a table; one row that says how to measure it where nothing was."""
    if not path.exists():
        return [{"machine": "a GPU", "form": "not measured", "clips": "", "ms of a closure": "", "memory, MiB": ""}]
    found = json.loads(path.read_text(encoding="utf-8"))
    return [
        {"machine": found["device"], "form": row["form"], "clips": row["clips"],
         "ms of a closure": f"{row['ms']:,.0f}", "memory, MiB": f"{row.get('used', float('nan')):,.0f}"}
        for row in found["rows"]
    ]  # fmt: skip


def main() -> None:
    """Measures and writes the file."""
    parser = argparse.ArgumentParser(prog=COMMAND, description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=FILE)
    out = parser.parse_args().out
    if not torch.cuda.is_available():
        raise SystemExit("no CUDA here: nothing was measured")
    found = measure()
    files.write_whole(out, json.dumps(found, indent=1) + "\n")
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
