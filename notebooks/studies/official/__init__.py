"""The official HuMoR code's own form of roll-out, body and unknowns, at its price: the reference for 04, 06 and 08."""
