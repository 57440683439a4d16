// Points attached to the skin of the robot: draggable or touchable markers, and cameras, which are fixed.

import { SkinnedMesh, Vector3 } from "three";
import type { Landmark } from "./alignment";
import type { Body } from "./body";
import type { NamedPoint, Vector } from "./data";

/** Attaches a point at rest to the nearest vertex; their offset rotates with the vertex's first bone.
 *
 * Returns a function of its current position, in the frame of the body's group. point: robot frame [m]. */
export function tie(body: Body, point: Vector): () => Vector3 {
  const at = new Vector3(...point);
  const { vertex, skin, offset } = nearest(body, at);
  return () => {
    const place = new Vector3();
    skin.getVertexPosition(vertex, place);
    const bone = skin.skeleton.bones[skin.geometry.getAttribute("skinIndex")!.getX(vertex)]!;
    return place.add(offset.clone().applyQuaternion(bone.quaternion).applyEuler(body.robotFrame.rotation));
  };
}

/** Markers and cameras of a robot, in the frame of the robot's group. */
export function landmarksOf(body: Body, markers: NamedPoint[], cameras: NamedPoint[]): Landmark[] {
  const moved = (place: () => Vector3): (() => Vector3) => () => place().add(body.group.position);
  const fixed = (camera: NamedPoint): Vector3 => new Vector3(...camera.position).applyEuler(body.robotFrame.rotation);
  return [
    ...markers.map((marker) => ({ name: marker.name, place: moved(tie(body, marker.position)) })),
    ...cameras.map((camera) => ({ name: camera.name, place: moved(() => fixed(camera)) })),
  ];
}

function nearest(body: Body, at: Vector3): { vertex: number; skin: SkinnedMesh; offset: Vector3 } {
  const seen = new Vector3(at.x, at.z, -at.y); // glTF's frame
  let best = { vertex: 0, skin: body.skins[0]!, offset: new Vector3() };
  let least = Infinity;
  const point = new Vector3();
  for (const skin of body.skins) {
    const places = skin.geometry.getAttribute("position");
    for (let v = 0; v < places.count; v++) {
      const distance = point.fromBufferAttribute(places, v).distanceToSquared(seen);
      if (distance >= least) continue;
      least = distance;
      best = { vertex: v, skin, offset: new Vector3(at.x - point.x, at.y + point.z, at.z - point.y) };
    }
  }
  return best;
}
