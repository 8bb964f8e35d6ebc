"""Time incdbscan on points from stdin (JSON), one insertion a keyframe; run by its own venv."""

import json
import sys
import time

import numpy as np
from incdbscan import IncrementalDBSCAN

job = json.load(sys.stdin)
points = np.array(job["points"], float)
model = IncrementalDBSCAN(eps=job["eps"], min_pts=job["min_samples"])
start = time.process_time()
for point in points:
    model.insert(point[np.newaxis])
seconds = time.process_time() - start
labels = model.get_cluster_labels(points)
json.dump({"seconds": seconds, "labels": [int(label) for label in labels]}, sys.stdout)
