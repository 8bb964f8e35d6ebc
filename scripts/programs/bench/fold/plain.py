"""Plain online DBSCAN, the baseline: each new point is compared with all others. O(n²)."""


def fold_plain(points: list[tuple[int, int]], eps_um: int, min_samples: int) -> list[int]:
    """Labels after the last point, -1 for noise."""
    eps2 = eps_um * eps_um
    neighbours: list[list[int]] = []
    labels: list[int] = []
    founded = 0
    for n, (x, y) in enumerate(points):
        near = [i for i in range(n) if (points[i][0] - x) ** 2 + (points[i][1] - y) ** 2 <= eps2]
        neighbours.append([*near, n])
        labels.append(-1)
        for i in near:
            neighbours[i].append(n)
        for core in (i for i in [*near, n] if len(neighbours[i]) >= min_samples):
            known = {labels[i] for i in neighbours[core] if len(neighbours[i]) >= min_samples}
            known -= {-1}
            place = min(known, default=founded)
            founded += not known
            for i in neighbours[core]:
                if labels[i] == -1:
                    labels[i] = place
            if len(known) > 1:
                labels = [place if label in known else label for label in labels]
    return labels
