// Spheres and capsules of the hand on primitives of the object.
//
// A capsule is met as balls at one or two places of its axis.
#pragma once
#include "contacts/capsule_box.cuh"
#include "contacts/primitives.cuh"

// Part of the axis, from -1 to 1, to which `CUTS` cuts narrow the place that is nearest to a primitive: 2 / 5^7.
constexpr int CUTS = 7;
constexpr float NARROWEST = 2.6e-5f;

DEV bool meeting_place(Sphere, Vec3 start, Vec3 axis, Vec3, int part, int, float &place) {
  place = clamp(-dot(start, axis) / fmaxf(dot(axis, axis), 1e-20f), -1.0f, 1.0f);
  return part == 0;
}

// The place of the axis that is nearest to a convex primitive. Along a line the distance to what is convex is convex:
// the lanes of a capsule look at its slope in four places, which cuts the bracket into five.
template <class Primitive>
DEV bool meeting_place(Primitive, Vec3 start, Vec3 axis, Vec3 size, int part, int lane, float &place) {
  float low = -1, width = 2;
#pragma unroll 1
  for (int cut = 0; cut < CUTS; cut++) {
    width *= 0.2f;
    Vec3 outward;
    distance(Primitive{}, start + (low + (part + 1) * width) * axis, size, outward);
    const unsigned falling = lanes_where(dot(outward, axis) < 0) >> (lane & ~3) & 15u;
    low += __popc(falling) * width;
  }
  // An end of the axis itself, exactly, where the bracket has closed on it.
  place = low == -1 ? -1.0f : low + width > 1 - 0.5f * NARROWEST ? 1.0f : low + 0.5f * width;
  return part == 0;
}

// A ball of each lane on one primitive.
template <class Primitive>
DEV int keep_ball(const Search &search, int count, int primitive, bool present, Vec3 centre, float radius, int geom) {
  const Solid &solid = search.found.primitives[primitive];
  Vec3 outward;
  const float gap = distance(Primitive{}, in_frame(solid, centre), solid.size, outward) - radius;
  const Vec3 normal = -(solid.rotation * outward);
  const bool touches = present && gap < 0;
  const int pair = touches ? OBJECT_PAIR[primitive][geom] : 0;
  return keep(search, count, touches, gap, centre + (radius + 0.5f * gap) * normal, normal, pair);
}

template <class Primitive>
DEV int spheres_on(const Search &search, int count, bool present, Vec3 centre, float radius, int geom) {
#pragma unroll 1
  for (int primitive = Primitive::FIRST; primitive < Primitive::FIRST + Primitive::COUNT; primitive++) {
    count = keep_ball<Primitive>(search, count, primitive, present, centre, radius, geom);
  }
  return count;
}

// Four lanes a capsule; `axis` is half of it.
template <class Primitive>
DEV int capsules_on(const Search &search, int count, bool present, Vec3 middle, Vec3 axis, float radius, int geom) {
  const int part = search.lane & 3;
#pragma unroll 1
  for (int primitive = Primitive::FIRST; primitive < Primitive::FIRST + Primitive::COUNT; primitive++) {
    const Solid &solid = search.found.primitives[primitive];
    const Vec3 start = in_frame(solid, middle), along = transposed_times(solid.rotation, axis);
    // The distance is convex: nowhere on the axis is it less than by its slope in the middle.
    Vec3 outward;
    const float gap = distance(Primitive{}, start, solid.size, outward) - radius;
    if (!lanes_where(present && gap < fabsf(dot(outward, along)))) continue;
    float place;
    const bool meets = meeting_place(Primitive{}, start, along, solid.size, part, search.lane, place);
    count = keep_ball<Primitive>(search, count, primitive, present && meets, middle + place * axis, radius, geom);
  }
  return count;
}

// A sphere or a capsule of the hand in the world.
struct Round {
  Vec3 middle, axis;  // half of its axis
  float radius;
};

DEV Round round_geom(const Search &search, int index) {
  const RoundGeom &geom = ROUND_GEOM[index];
  const Pose &pose = search.shared.pose[geom.link];
  const float radius = geom.size < 0 ? geom.radius : geom_size(search, geom.size).x;
  return {in_world(pose, geom.place), pose.rotation * geom.half_axis, radius};
}

// Spheres and capsules on everything but capsules of the object, for capsules (`capsules_meet`).
DEV int balls_meet(const Search &search, int count) {
#pragma unroll 1
  for (int first = 0; first < SPHERES; first += 32) {
    const int geom = first + search.lane;
    const Round ball = round_geom(search, smaller(geom, SPHERES - 1));
    const bool present = geom < SPHERES;
    count = spheres_on<Box>(search, count, present, ball.middle, ball.radius, geom);
    count = spheres_on<Capsule>(search, count, present, ball.middle, ball.radius, geom);
    count = spheres_on<Cylinder>(search, count, present, ball.middle, ball.radius, geom);
    count = spheres_on<Sphere>(search, count, present, ball.middle, ball.radius, geom);
    count = spheres_on<Ellipsoid>(search, count, present, ball.middle, ball.radius, geom);
  }
#pragma unroll 1
  for (int first = 0; first < CAPSULES; first += 8) {
    const int geom = SPHERES + first + search.lane / 4;
    const Round swept = round_geom(search, smaller(geom, SPHERES + CAPSULES - 1));
    const bool present = geom < SPHERES + CAPSULES;
    count = capsules_on<Box>(search, count, present, swept.middle, swept.axis, swept.radius, geom);
    count = capsules_on<Cylinder>(search, count, present, swept.middle, swept.axis, swept.radius, geom);
    count = capsules_on<Sphere>(search, count, present, swept.middle, swept.axis, swept.radius, geom);
    count = capsules_on<Ellipsoid>(search, count, present, swept.middle, swept.axis, swept.radius, geom);
  }
  return count;
}
