"""The paper on arrays: matches of two images, their scores, grids of parameters, rankings, recall.

`types` holds the values: the Features of two images become Matches. `matching` finds them with `nearest`, and the
same ones faster with products of bfloat16 in `checked`, which can be deleted with its tests. `scorer` states what a
score is, a function of the matches of one pair, and reads its parameters; `weights` is what it sees of a match. The
paper's scores stand in `aggregate` (read it first), `anchor` and `histogram`, each from the equation to the result.
`batch` scores all candidates of a query, and grids, with `vmap` and `lax.map` around the function of one pair;
`ranking` sorts the scores, `metrics` counts the hits. A function is compiled where it says `@compiled`, once for each
shape and type of the arrays, static field, class of a score, and capacity of bins (of candidates, a multiple of 8):
other numbers compile nothing. A score of one pair, `scorer(matches)`, runs operation by operation. To add a score,
write a class like `AggregatedScore`, and call `mfvpr.testing.check_scorer` in its test; the README beside this says
how programs learn its name. The example uses jax, numpy as np, `dataclasses.replace` and names of this package:

    unit = lambda rows: rows / np.linalg.norm(rows, axis=-1, keepdims=True)
    rng = np.random.default_rng(0)
    places = unit(rng.normal(size=(3, 40, 64)))  # descriptors of C = 3 candidates [C, N, D]
    seen = unit(places[1] + 0.1 * rng.normal(size=(40, 64)))  # of a query at the second place [N, D]

    points, sizes = rng.uniform(0, 300, (40, 2)), np.full((3, 2), 336.0)  # (x, y) px
    query = Features.of(points, seen, image_size=sizes[0])
    candidates = Features.of(np.stack([points + 9.0] * 3), places, image_size=sizes)
    matches = match_candidates(query, candidates, with_ratio=True)  # [C, K]

    scorer = HistogramOfShifts(sigma=22.5)
    order = rank(score_candidates(scorer, matches))  # candidates, the best first: order[0] is 1
    grid = score_grid(scorer, matches, sigma=[10.0, 22.5], weight=["fs", "ratio"])  # [sigma, weight, C]
    score_of = lambda sigma: score_candidates(replace(scorer, sigma=sigma), matches)[1]
    slope = jax.grad(score_of)(22.5)
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
