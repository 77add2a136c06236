"""Vectors that were computed elsewhere, one a frame, beside vplog's own recognisers.

python examples/own_vectors.py LOG VECTORS.parquet [SETTING=VALUE ...]
"""

import sys

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

import vplog

path, file, *settings = sys.argv[1:]
stamps, vectors = [], []
log = vplog.open_log(path)
for frame in log.frames(log.stamps()):
    rows = np.array_split(frame.decode().image.astype(np.float32), 8)
    blocks = [block.mean() for row in rows for block in np.array_split(row, 8, axis=1)]  # your network's here
    stamps.append(frame.stamp_ns)
    vectors.append(np.array(blocks) - np.mean(blocks))
pq.write_table(pa.table({"stamp_ns": stamps, "vector": vectors}), file)

found = vplog.compare(
    path, methods=["gist", f"vectors:{file}"], truth="poses", min_gap=15, library_size=4, settings=settings
)
for name, figures in found.record["methods"].items():
    print(f"{name} recall at 1: {figures['r_at_1']:.2f}, {figures['bits']} bits a place")
