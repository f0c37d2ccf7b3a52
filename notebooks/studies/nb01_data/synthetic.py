"""Whether the synthetic corpus of notebook 01 is ground truth."""

from data_synth import corpus, faults
from data_synth.audit import audit

#: Faults put in on purpose: 5 cm/s of drift, 1 cm too low, knees reflected.
FAULTS = (lambda motion: faults.drifting(motion, 0.05), faults.lowered, faults.knees_reflected)


def audited(free: corpus.Corpus, still: corpus.Corpus) -> dict[str, tuple[list[float], list[float]]]:
    """Computes the worst of every sequence by test, and of its first ten seconds with a fault put in on purpose.

    planted: mm per frame. floor: mm. limits: degrees, of both versions.
    """
    good = [audit(s.motion) for s in free.sequences]
    drift, low, knees = ([audit(spoil(s.motion.cut(0, 300))) for s in free.sequences] for spoil in FAULTS)
    both = [*(audit(s.motion) for s in still.sequences), *good]
    return {
        "planted": ([1000 * a.contact_speed for a in good], [1000 * a.contact_speed for a in drift]),
        "floor": ([1000 * a.penetration for a in good], [1000 * a.penetration for a in low]),
        "limits": ([a.limit_excess for a in both], [a.limit_excess for a in knees]),
    }
