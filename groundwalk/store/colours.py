"""One meaning, one colour, in recordings and figures alike (Okabe-Ito, which colour-blind readers can distinguish)."""

GROUND_TRUTH = (0, 158, 115)
VIO = (230, 159, 0)
APR = (86, 180, 233)
FUSED = (204, 121, 167)
REJECTED = (213, 94, 0)
NEUTRAL = (150, 150, 150)

# Of kinds of poses beyond these, in order; far from the ones above and from each other.
MORE_COLOURS = ((240, 228, 66), (166, 86, 40), (102, 166, 30), (117, 112, 179), (231, 41, 138), (0, 114, 178))
