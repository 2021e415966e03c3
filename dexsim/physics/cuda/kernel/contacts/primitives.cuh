// Distances of points to the object's primitives (dexsim/geometry/sdf.py), in the primitives' frames.
//
// Each returns the signed distance in m and its gradient `outward`, the unit normal of the nearest surface.
#pragma once
#include "contacts/search.cuh"

struct Sphere {
  static constexpr int FIRST = FIRST_SPHERE, COUNT = SPHERE_PRIMITIVES;
};
struct Capsule {
  static constexpr int FIRST = FIRST_CAPSULE, COUNT = CAPSULE_PRIMITIVES;
};
struct Ellipsoid {
  static constexpr int FIRST = FIRST_ELLIPSOID, COUNT = ELLIPSOID_PRIMITIVES;
};
struct Cylinder {
  static constexpr int FIRST = FIRST_CYLINDER, COUNT = CYLINDER_PRIMITIVES;
};
struct Box {
  static constexpr int FIRST = FIRST_BOX, COUNT = BOX_PRIMITIVES;
};

DEV float distance(Sphere, Vec3 point, Vec3 size, Vec3 &outward) {
  outward = point;
  return normalize(outward) - size.x;
}

DEV float distance(Capsule, Vec3 point, Vec3 size, Vec3 &outward) {
  outward = {point.x, point.y, point.z - clamp(point.z, -size.y, size.y)};
  return normalize(outward) - size.x;
}

DEV float distance(Cylinder, Vec3 point, Vec3 size, Vec3 &outward) {
  Vec3 side = {point.x, point.y, 0};
  const float radial = normalize(side) - size.x, axial = fabsf(point.z) - size.y;
  const float deepest = fmaxf(radial, axial);
  // Over the rim both count; on flank or cap, and inside, the one that is nearer.
  float sideways = fmaxf(radial, 0.0f), upward = fmaxf(axial, 0.0f);
  if (deepest <= 0) {
    sideways = radial >= axial ? 1.0f : 0.0f;
    upward = 1.0f - sideways;
  }
  outward = {sideways * side.x, sideways * side.y, copysignf(upward, point.z)};
  const float outside = normalize(outward);
  return deepest <= 0 ? deepest : outside;
}

DEV float distance(Box, Vec3 point, Vec3 size, Vec3 &outward) {
  const Vec3 beyond = absolute(point) - size;
  const float deepest = fmaxf(fmaxf(beyond.x, beyond.y), beyond.z);
  Vec3 way = {fmaxf(beyond.x, 0.0f), fmaxf(beyond.y, 0.0f), fmaxf(beyond.z, 0.0f)};
  if (deepest <= 0) {  // inside: the nearest face
    way.x = beyond.x == deepest ? 1.0f : 0.0f;
    way.y = beyond.y == deepest ? 1.0f - way.x : 0.0f;
    way.z = 1.0f - way.x - way.y;
  }
  const float outside = normalize(way);
  outward = {copysignf(way.x, point.x), copysignf(way.y, point.y), copysignf(way.z, point.z)};
  return deepest <= 0 ? deepest : outside;
}

// The nearest point is s^2 p / (t + s^2) with the largest root t of sum (s p / (t + s^2))^2 = 1, by Newton's method
// from the left, which converges monotonically. The unknown is t + min(s)^2: deep inside t is all but -min(s)^2.
DEV float distance(Ellipsoid, Vec3 point, Vec3 size, Vec3 &outward) {
  const float least = fminf(fminf(size.x, size.y), size.z);
  const Vec3 gap = {(size.x - least) * (size.x + least), (size.y - least) * (size.y + least),
                    (size.z - least) * (size.z + least)};
  const Vec3 p = absolute(point) + Vec3{1e-9f, 1e-9f, 1e-9f};
  const Vec3 scaled = {size.x * p.x, size.y * p.y, size.z * p.z};
  float root = fmaxf(fmaxf(scaled.x - gap.x, scaled.y - gap.y), scaled.z - gap.z);
  Vec3 unit;
#pragma unroll 1
  for (int step = 0;; step++) {
    const Vec3 inverse = {1 / (root + gap.x), 1 / (root + gap.y), 1 / (root + gap.z)};
    unit = {scaled.x * inverse.x, scaled.y * inverse.y, scaled.z * inverse.z};
    if (step == 12) break;
    const float slope = unit.x * unit.x * inverse.x + unit.y * unit.y * inverse.y + unit.z * unit.z * inverse.z;
    root += 0.5f * (dot(unit, unit) - 1) / slope;
  }
  outward = {unit.x / size.x, unit.y / size.y, unit.z / size.z};
  normalize(outward);
  const Vec3 surface = {size.x * unit.x, size.y * unit.y, size.z * unit.z};
  const float away = dot(outward, p - surface);
  outward = {copysignf(outward.x, point.x), copysignf(outward.y, point.y), copysignf(outward.z, point.z)};
  return away;
}
