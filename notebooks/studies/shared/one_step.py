"""The decoupled roll-out with one decoding step: every transition for itself."""

from torch import Tensor

from motionlab.humor.priors import Cvae
from motionlab.humor.rollout import rollout


def decode_ahead(model: Cvae, states: Tensor, z: Tensor) -> Tensor:
    """Computes one transition from every state at once: (B, T, 339), entry [b, t] predicts the state t + 1.

    states (B, T, 339), world; z (B, T, 48) of the transition out of each state.
    Source: thesis 3.3.1, the decoupled roll-out with one decoding step.
    """
    found = rollout(model, states.flatten(0, 1), z.flatten(0, 1)[:, None], with_prior=False).states
    return found.unflatten(0, states.shape[:2])[:, :, 0]
