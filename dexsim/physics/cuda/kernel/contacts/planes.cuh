// Planes of the hand (a palm's face) under primitives of the object: one place of a primitive a lane.
#pragma once
#include "contacts/search.cuh"

// Kinds of PLANE_POINT, in the order of scene.py.
enum { ON_SPHERE, ON_CAPSULE, ON_ELLIPSOID, ON_CYLINDER, ON_BOX };

// The lowest place of each disk of a cylinder, and two more of the lower disk, 120 degrees apart.
DEV Vec3 lowest_of_cylinder(Vec3 size, Vec3 down, int corner) {
  Vec3 rim = {down.x, down.y, 0};
  const float lower = copysignf(size.y, down.z);
  if (normalize(rim) < 1e-7f) rim = {1, 0, 0};  // upright
  if (corner < 2) return {size.x * rim.x, size.x * rim.y, corner ? -lower : lower};
  const float side = corner == 2 ? 0.8660254f : -0.8660254f;
  return {size.x * (-0.5f * rim.x - side * rim.y), size.x * (-0.5f * rim.y + side * rim.x), lower};
}

// A place of a primitive that may touch a plane; `down` leads to the plane, both in the primitive's solid.
DEV Vec3 lowest(int kind, Vec3 size, Vec3 down, int corner) {
  switch (kind) {
    case ON_CAPSULE:
      return size.x * down + Vec3{0, 0, corner ? -size.y : size.y};
    case ON_ELLIPSOID: {
      Vec3 unit = {size.x * down.x, size.y * down.y, size.z * down.z};
      normalize(unit);
      return {size.x * unit.x, size.y * unit.y, size.z * unit.z};
    }
    case ON_CYLINDER:
      return lowest_of_cylinder(size, down, corner);
    case ON_BOX:
      return {corner & 1 ? size.x : -size.x, corner & 2 ? size.y : -size.y, corner & 4 ? size.z : -size.z};
    default:
      return size.x * down;
  }
}

DEV int planes_meet(const Search &search, int count) {
#pragma unroll 1
  for (int first = 0; first < PLANE_POINTS; first += 32) {
    const int index = first + search.lane;
    const PlanePoint row = PLANE_POINT[smaller(index, PLANE_POINTS - 1)];
    const PlaneGeom plane = PLANE_GEOM[row.plane];
    const Solid &solid = search.found.primitives[row.primitive];
    const Vec3 down = -transposed_times(solid.rotation, plane.normal);
    const Vec3 corner = lowest(row.kind, solid.size, down, row.corner);
    const Vec3 point = solid.place + solid.rotation * corner;
    const float gap = dot(point - plane.place, plane.normal);
    // Of a box only the lower corners count, however deep it is.
    const bool touches = index < PLANE_POINTS && gap < 0 && (row.kind != ON_BOX || dot(corner, down) >= 0);
    const int pair = touches ? OBJECT_PAIR[row.primitive][FIRST_PLANE_GEOM + row.plane] : 0;
    count = keep(search, count, touches, gap, point - 0.5f * gap * plane.normal, plane.normal, pair);
  }
  return count;
}
