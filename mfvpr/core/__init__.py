"""The paper on arrays: matches of two images, their scores, grids of parameters, rankings, recall.

`types` holds the values: Features of an image become Matches of a pair. `nearest` and `matching` find the matches;
`checked` finds the same ones faster with products of bfloat16, and can be deleted. `weights` and `shifts` are what
scores see of a match. `scorer` states the contract of a score, a function of the matches of one pair. The class of a
score declares its fields with `setting` of `mfvpr.utils.fields`; `parameters` reads and replaces them by name.
`aggregate` holds the shortest scores; read it before `histogram` and `anchor`, which also stand in one file each, from
the equation to the result. `batch` scores all candidates of a query, and grids, with `vmap` and `lax.map` around the
function of one pair. `ranking` and `metrics` sort the scores and count the hits.

A function is compiled where it says `@compiled`, which is `jit` that keeps its programs: one for each shape of the
arrays, static field, class of a scorer, and capacity of bins (a multiple of 8, from the sizes of images and bins).
Other numbers in a scorer compile nothing. A score of one pair, `scorer(matches)`, runs operation by operation.

To add a score, write a class like `AggregatedScore`, and call `mfvpr.testing.check_scorer` in its test; the README
beside this file says how programs learn its name.

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
