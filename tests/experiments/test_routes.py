"""The table of routes, from predictions of a drive."""

import csv

import numpy as np

from experiments import routes


def test_routes_are_compared_with_images_alone(tmp_path, capsys):
    rng = np.random.default_rng(0)
    with (tmp_path / "predictions.csv").open("w", newline="") as stream:
        lines = csv.writer(stream)
        lines.writerow(["query", "rank", "database", "score", "correct"])
        for query in range(100):
            best = query if rng.uniform() < 0.7 else int(rng.integers(100))
            rest = [row for row in rng.permutation(100).tolist() if row != best][:9]
            for rank, row in enumerate([best, *rest], start=1):
                score = 3.0 if rank == 1 else 3.0 - rng.uniform(1, 2)
                lines.writerow([f"{query:03d}.png", rank, f"{row:03d}.png", score, int(abs(row - query) <= 2)])
    routes.run([tmp_path])
    table = [line.strip("| ").split(" | ") for line in capsys.readouterr().out.splitlines()[2:]]
    assert [cells[1] for cells in table] == [
        "as they are", "every fourth", "every second, backwards", "with stops", "clips",
    ]  # fmt: skip
    for _, drive, alone, learned, _, speed_1 in table:
        assert float(alone) < 85
        assert float(learned) > float(alone)
        if drive.startswith("every"):
            assert float(speed_1) < float(learned)
