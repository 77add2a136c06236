"""The trajectory on the earth, WGS84: GeoJSON (RFC 7946), GeoParquet 1.1 and KML (OGC 12-007r2), longitude before
latitude; and in metres of UTM."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pyarrow as pa

from vplog.data import Closures, Floats, Ints, Trajectory
from vplog.geometry import se3
from vplog.geometry.geodesy import geodetic, utm, utm_zone
from vplog.storage.parquet_limits import write_table
from vplog.storage.scratch import replacing

_DEGREE_DIGITS, _METRE_DIGITS = 8, 3
"""Decimals of GeoJSON: 1e-8 degrees are a millimetre."""
_POINT_Z = struct.pack("<BI", 1, 1001)
"""Head of a point in ISO WKB: little endian, POINT Z (OGC 06-103r4, table 4)."""


@dataclass(frozen=True, eq=False)
class Earth:
    """Pose of the trajectory's frame on earth."""

    origin: tuple[float, float, float]
    """Latitude and longitude in degrees and altitude in m, WGS84."""
    enu_from_world: Floats
    """(4, 4): from the trajectory's frame to m east, north and up of the origin; a similarity where the trajectory has
    a unit of length of its own."""
    point: Floats = field(default_factory=lambda: np.zeros(3))
    """(3,) of the body in the trajectory's unit: the point laid on earth, the camera of a run without metres."""


def on_earth(earth: Earth, world_from_body: Floats) -> Floats:
    """(T, 3) longitude and latitude in degrees and altitude in m of poses (T, 4, 4)."""
    enu = se3.transform(earth.enu_from_world, se3.transform(world_from_body, earth.point[None])[:, 0])
    return geodetic(enu, earth.origin)[:, [1, 0, 2]]


def feature_collection(earth: Earth, world_from_body: Floats, stamp_ns: Ints, closures: Closures) -> dict[str, Any]:
    """GeoJSON of keyframes (N, 4, 4): the path as one line, and of each accepted closure the line between its ends.
    Longitudes go on beyond 180 degrees, so that no line across the antimeridian goes around the earth."""
    degrees = on_earth(earth, world_from_body)
    degrees[:, 0] = np.unwrap(degrees[:, 0], period=360.0)
    where = [[round(x, _DEGREE_DIGITS), round(y, _DEGREE_DIGITS), round(z, _METRE_DIGITS)] for x, y, z in degrees]
    features = []
    if len(where) > 1:
        about = {"name": "optimised", "start_ns": str(stamp_ns[0]), "end_ns": str(stamp_ns[-1])}
        features.append(_line(where, about))
    for row in np.flatnonzero(closures.accepted).tolist():
        query, match = int(closures.query[row]), int(closures.match[row])
        about = {"name": "closure", "closure": row, "query": query, "match": match}
        features.append(_line([where[match], where[query]], about))
    return {"type": "FeatureCollection", "features": features}


def write_geojson(path: Path, tree: dict[str, Any]) -> None:
    with replacing(path) as stream:
        stream.write((json.dumps(tree, separators=(",", ":"), allow_nan=False) + "\n").encode())


def write_kml(path: Path, tree: dict[str, Any], name: str) -> None:
    """The lines of `feature_collection`, on the ground: a map's heights are not those of the ellipsoid."""
    kml = ElementTree.Element("kml", xmlns="http://www.opengis.net/kml/2.2")
    document = ElementTree.SubElement(kml, "Document")
    for feature in tree["features"]:
        about, where = feature["properties"], feature["geometry"]["coordinates"]
        # KML has longitudes within 180 degrees
        points = [f"{(x + 180.0) % 360.0 - 180.0:.{_DEGREE_DIGITS}f},{y:.{_DEGREE_DIGITS}f}" for x, y, _ in where]
        mark = ElementTree.SubElement(document, "Placemark")
        ElementTree.SubElement(mark, "name").text = f"closure {about['closure']}" if "closure" in about else name
        line = ElementTree.SubElement(mark, "LineString")
        ElementTree.SubElement(line, "tessellate").text = "1"
        ElementTree.SubElement(line, "coordinates").text = " ".join(points)
    with replacing(path) as stream:
        stream.write(ElementTree.tostring(kml, encoding="utf-8", xml_declaration=True) + b"\n")


def write_utm(path: Path, trajectory: Trajectory, earth: Earth) -> None:
    """`stamp_ns,easting_m,northing_m,altitude_m,zone`, every sample in the zone of the first, as `33N`."""
    where = on_earth(earth, trajectory.world_from_body)
    zone = utm_zone(*where[0, :2]) if len(where) else 1
    metres = utm(where[:, 1], where[:, 0], zone)
    letter = "N" if not len(where) or where[0, 1] >= 0 else "S"
    with replacing(path) as stream:
        stream.write(b"stamp_ns,easting_m,northing_m,altitude_m,zone\n")
        rows = zip(trajectory.stamp_ns.tolist(), metres.tolist(), where[:, 2].tolist(), strict=True)
        for stamp_ns, (east, north), up in rows:
            stream.write(f"{stamp_ns},{east:.3f},{north:.3f},{up:.3f},{zone}{letter}\n".encode())


def write_geoparquet(path: Path, trajectory: Trajectory, earth: Earth, header: dict[str, str]) -> None:
    """One point with altitude for every sample, as GeoParquet 1.1 (geoparquet.org/releases/v1.1.0).

    `header` is that of the run's own tables.
    """
    where = on_earth(earth, trajectory.world_from_body)
    low, high = (where.min(0), where.max(0)) if len(where) else (np.zeros(3), np.zeros(3))
    schema = pa.schema(
        [pa.field("stamp_ns", pa.int64(), False), pa.field("geometry", pa.binary(), False)],
        metadata={**header, "vplog.table": "geo", **geo_header(low, high)},
    )
    table = pa.Table.from_arrays([pa.array(trajectory.stamp_ns, pa.int64()), points(where)], schema=schema)
    with replacing(path) as stream:
        write_table(stream, table, compression="zstd")


def points(where: Floats) -> pa.Array:
    """(T, 3) longitudes, latitudes and altitudes as WKB."""
    return pa.array([_POINT_Z + row.tobytes() for row in where.astype("<f8")], pa.binary())


def geo_header(low: Floats, high: Floats) -> dict[str, str]:
    """The GeoParquet header of a table with such points; `low` and `high` (3,) are those of the box."""
    column = {"encoding": "WKB", "geometry_types": ["Point Z"], "bbox": [*low.tolist(), *high.tolist()]}
    return {"geo": json.dumps({"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": column}})}


def _line(where: list[list[float]], properties: dict[str, Any]) -> dict[str, Any]:
    geometry_ = {"type": "LineString", "coordinates": where}
    return {"type": "Feature", "geometry": geometry_, "properties": properties}
