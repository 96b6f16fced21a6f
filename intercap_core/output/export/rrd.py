"""A recording for the Rerun viewer: cameras with images, body, object, contact, estimated errors.

Entities:
    world/body: mesh, whose vertices are logged in each frame; world/body/contact: those that
        touch the object.
    world/object: pose; world/object/mesh: its mesh; world/object/mesh/contact: its vertices that
        touch the body.
    world/cameras/<name>: pose and pinhole; world/cameras/<name>/image: undistorted JPEG images.
    errors/<part>: estimated error in millimetres, by frame.
    about: the body file, coordinates and facts about each frame, as JSON.

All have two timelines, ``time`` in seconds and ``frame``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from intercap_core.geometry.camera.transforms import apply
from intercap_core.geometry.rigid.surfaces import vertex_normals
from intercap_core.output.export import images
from intercap_core.output.export.format import Content, ExportFormat
from intercap_core.output.export.motion import Coordinates

# Six cameras of 15 images a second need some 2 MB per second at this size, the body's mesh 5 MB.
MAX_WIDTH = 640  # pixels
JPEG_QUALITY = 80
_SKIN, _CONTACT = (184, 153, 133), (220, 40, 40)  # sRGB
_CONTACT_RADIUS = 0.003  # metres, of the points that mark touching vertices


def _write(folder: Path, content: Content) -> Coordinates:
    import rerun as rr

    sequence, coordinates = content.motion.sequence, Coordinates.of(content.viewed)
    recording = rr.RecordingStream("intercap-core", recording_id=sequence)
    recording.save(folder / f"{sequence}.rrd", default_blueprint=_layout(content))
    about = content.about.to_json_text(coordinates)
    recording.log("about", rr.TextDocument(about, media_type="application/json"), static=True)
    up = rr.ViewCoordinates.RIGHT_HAND_Z_UP if content.is_z_up else rr.ViewCoordinates.RDF
    recording.log("world", up, static=True)
    _log_body(recording, content)
    if content.mesh is not None:
        _log_object(recording, content)
    for number in range(len(content.recorded)):
        _log_camera(recording, content, number)
    verdict = content.about.verdict
    for part in verdict.stated_parts:
        errors = verdict.per_frame_mm[part]
        for t in np.flatnonzero(np.isfinite(errors)).tolist():
            _set_frame(recording, content, t)
            recording.log(f"errors/{verdict.stated[part].part}", rr.Scalars(errors[t]))
    recording.flush()
    recording.disconnect()
    return coordinates


def _layout(content: Content) -> Any:
    """Lay out the viewer: scene and errors on the left, images of all cameras on the right."""
    import rerun.blueprint as blueprint

    scene = blueprint.Spatial3DView(origin="world", name="scene")
    errors = blueprint.TimeSeriesView(origin="errors", name="estimated errors, mm")
    views = [
        blueprint.Spatial2DView(origin=f"world/cameras/{camera.name}/image", name=camera.name)
        for camera in content.recorded
    ]
    about = blueprint.TextDocumentView(origin="about", name="facts")
    return blueprint.Blueprint(
        blueprint.Horizontal(
            blueprint.Vertical(scene, errors, row_shares=[3, 1]),
            blueprint.Tabs(blueprint.Grid(*views, name="images"), about),
        ),
        collapse_panels=True,
    )


def _set_frame(recording: Any, content: Content, t: int) -> None:
    recording.set_time("frame", sequence=t)
    recording.set_time("time", duration=float(content.scenes.times[t]))


def _log_body(recording: Any, content: Content) -> None:
    import rerun as rr

    faces = content.motion.model.faces.numpy().astype(np.uint32)
    material = rr.Mesh3D.from_fields(triangle_indices=faces, albedo_factor=_SKIN)
    recording.log("world/body", material, static=True)
    touching = content.about.touching
    for t, in_master in enumerate(content.scenes.bodies):
        vertices = apply(content.viewed_from_master, in_master)
        _set_frame(recording, content, t)
        normals = vertex_normals(vertices, faces)  # without them, the viewer draws no shading
        surface = rr.Mesh3D.from_fields(vertex_positions=vertices, vertex_normals=normals)
        recording.log("world/body", surface)
        if touching is not None:
            _log_contact(recording, "world/body/contact", vertices[touching.body.at(t)])


def _log_object(recording: Any, content: Content) -> None:
    import rerun as rr

    mesh, motion, touching = content.mesh, content.viewed, content.about.touching
    assert mesh is not None
    shape = rr.Mesh3D(
        vertex_positions=mesh.vertices,
        triangle_indices=mesh.faces,
        vertex_normals=vertex_normals(mesh.vertices, mesh.faces),
        vertex_colors=mesh.colours,
    )
    known = np.isfinite(motion.translation).all(axis=1)
    for t in range(len(motion)):
        _set_frame(recording, content, t)
        before = known[t - 1] if t else False
        if known[t]:
            if not before:  # the mesh is not static, so that it disappears with the pose
                recording.log("world/object/mesh", shape)
            pose = rr.Transform3D(translation=motion.translation[t], mat3x3=motion.rotation[t])
            recording.log("world/object", pose)
            if touching is not None:
                vertices = mesh.vertices[touching.object_.at(t)]
                _log_contact(recording, "world/object/mesh/contact", vertices)
        elif before:
            recording.log("world/object", rr.Clear(recursive=True))


def _log_contact(recording: Any, entity: str, points: np.ndarray) -> None:
    import rerun as rr

    recording.log(entity, rr.Points3D(points, colors=_CONTACT, radii=_CONTACT_RADIUS))


def _log_camera(recording: Any, content: Content, number: int) -> None:
    """Log a camera's pose, and its images resampled to a pinhole of at most MAX_WIDTH columns."""
    import rerun as rr

    assert content.frames is not None
    camera = content.recorded[number]
    pinhole = images.undistorted(content.recorded)[number].colour
    scaled = pinhole.scaled(min(1.0, MAX_WIDTH / pinhole.width))
    entity = f"world/cameras/{camera.name}"
    pose = content.viewed_from_master @ camera.master_from_colour
    recording.log(
        entity,
        rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]),
        rr.Pinhole(
            image_from_camera=scaled.matrix,
            resolution=[scaled.width, scaled.height],
            camera_xyz=rr.ViewCoordinates.RDF,
        ),
        static=True,
    )
    resampling = images.Resampling(camera, pinhole)
    size = (scaled.width, scaled.height)
    for image, t in content.scenes.frames_of(number).items():
        if image not in content.image_names[number]:
            continue  # only depth was recorded
        pixels = resampling.colour(content.frames.colour(image, number))
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
        packet = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
        _set_frame(recording, content, t)
        encoded = rr.EncodedImage(contents=packet.tobytes(), media_type="image/jpeg")
        recording.log(f"{entity}/image", encoded)


_README = """
rrd/*.rrd           recording for the Rerun viewer: body{{ ", object, contact" if mesh }}, cameras,
    undistorted JPEG images of at most 640 columns, estimated errors (millimetres)
  timelines time (seconds) and frame; entity about: the facts about each frame, below, as JSON
  frame: {{ viewed.frame }}; {{ up }}
"""
FORMATS = (
    ExportFormat(
        name="rrd",
        content="body, object, contact, images and estimated errors for the Rerun viewer",
        includes="*/export/rrd/*.rrd",
        readme=_README,
        write=_write,
        reads_images=True,
        draws_bodies=True,
        library="rerun",
        extra="rerun",
    ),
)
