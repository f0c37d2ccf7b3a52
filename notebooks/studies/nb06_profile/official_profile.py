"""What the official code was measured to take, on its own machine: ``official_profile.toml``, and what follows from it.

One profile, not a sample: every number is n = 1, whatever the runs behind its median.
"""

import tomllib
from dataclasses import dataclass
from pathlib import Path

FILE = Path(__file__).with_name("official_profile.toml")
#: What all rows of a table or panels of a figure call it.
LABEL = "official code, its own machine"


@dataclass(frozen=True)
class Official:
    """The table as it stands in the file.

    phases: name, closures of the schedule, seconds of one, and shares of it. alone: seconds of the roll-out by itself,
    forward and back. batches: clips -> (seconds of a closure, bytes that the process held).
    """

    source: str
    machine: str
    runs: str
    drift: float
    phases: tuple[dict, ...]
    alone: dict[str, float]
    batches: dict[int, tuple[float, float]]

    def minutes(self) -> dict[str, dict[str, float]]:
        """Computes minutes of the whole schedule by phase and part, as ``program.minutes``."""
        found = {}
        for p in self.phases:
            shares = {"roll-out function": p["rollout"], "backward": p["backward"]}
            shares["body and energies"] = 1 - sum(shares.values())
            found[p["name"]] = {name: share * (p["closures"] * p["seconds"] / 60) for name, share in shares.items()}
        return found

    def shares(self) -> dict[str, float]:
        """Computes shares in %: three of the whole program, and the roll-out with its gradient of a closure."""
        third = [parts for name, parts in self.minutes().items() if name.startswith("stage 3")]
        spent = {"stage-3 closure": sum(sum(parts.values()) for parts in third)}
        spent |= {part: sum(parts[part] for parts in third) for part in ("backward", "roll-out function")}
        shares = {name: 100 * minutes / self.total for name, minutes in spent.items()}
        return shares | {"roll-out and its gradient": 100 * self.alone["both"] / self.closure}

    @property
    def total(self) -> float:
        """Minutes of the whole schedule."""
        return sum(sum(parts.values()) for parts in self.minutes().values())

    @property
    def closure(self) -> float:
        """Seconds of one closure of stage 3, all frames of one clip."""
        return self.batches[1][0]

    def range(self, share: float) -> tuple[float, float]:
        """Computes how far a share that was put together from two measurements may be off, by the drift of one."""
        return share * (1 - self.drift), share * (1 + self.drift)

    def fits(self, limit: float) -> float:
        """Computes how many clips a straight line through the two batches puts into ``limit`` bytes."""
        (few, (_, least)), (many, (_, most)) = self.batches.items()
        return few + (limit - least) * (many - few) / (most - least)


def load(path: Path = FILE) -> Official:
    """Reads the table, times in seconds and memory in bytes."""
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    alone = {name: ms / 1e3 for name, ms in table.pop("alone").items()}
    alone |= {"both": alone["forward"] + alone["backward"]}
    alone |= {"both, weights frozen": alone["forward_frozen"] + alone["backward_frozen"]}
    phases = tuple(row | {"seconds": _middle(row["ms"])} for row in table.pop("phase"))
    batches = {row["clips"]: (_middle(row["ms"]), 1e9 * row["resident"]) for row in table.pop("batch")}
    return Official(**table, phases=phases, alone=alone, batches=batches)


def _middle(ms: list[float]) -> float:
    return sum(ms) / len(ms) / 1e3
