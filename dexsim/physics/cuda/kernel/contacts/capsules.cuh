// Capsules (or spheres) on capsules: of two fingers, or of the hand and the object.
#pragma once
#include "contacts/balls.cuh"

// Squared sine of the angle between axes below which they count as parallel, as in C MuJoCo.
constexpr float PARALLEL = 1e-8f;

DEV Round round_primitive(const Search &search, int primitive) {
  const Solid &solid = search.found.primitives[primitive];
  return {solid.place, solid.size.y * column(solid.rotation, 2), solid.size.x};
}

// The places, from -1 to 1, that are nearest to each other on two axes.
DEV void nearest_places(Vec3 away, Vec3 one, Vec3 two, float &place, float &other) {
  const Vec3 normal = cross(one, two);
  const float mixed = dot(one, two), first = fmaxf(dot(one, one), 1e-20f), second = fmaxf(dot(two, two), 1e-20f);
  place = clamp(dot(cross(away, two), normal) / fmaxf(dot(normal, normal), 1e-30f), -1.0f, 1.0f);
  other = clamp((mixed * place - dot(two, away)) / second, -1.0f, 1.0f);
  place = clamp((mixed * other + dot(one, away)) / first, -1.0f, 1.0f);
}

// Parallel axes touch at both ends of the stretch in which they run side by side, as in C MuJoCo also where that is one
// place.
DEV void place_of_end(float end, Vec3 away, Vec3 one, Vec3 two, float &place, float &other) {
  const float first = dot(one, one), mixed = dot(one, two);
  place = clamp((dot(one, away) + end * fabsf(mixed)) / first, -1.0f, 1.0f);
  other = clamp((mixed * place - dot(two, away)) / dot(two, two), -1.0f, 1.0f);
}

DEV int capsules_meet(const Search &search, int count) {
#pragma unroll 1
  for (int first = 0; first < ROUND_PAIRS; first += 32) {
    const int index = first + search.lane;
    const bool present = index < ROUND_PAIRS;
    const RoundPair row = ROUND_PAIR[smaller(index, ROUND_PAIRS - 1)];
    const Round one = round_geom(search, row.first);
    const Round two = CAPSULE_PRIMITIVES && row.second < 0 ? round_primitive(search, -1 - row.second)
                                                          : round_geom(search, row.second);
    const Vec3 away = two.middle - one.middle, normal = cross(one.axis, two.axis);
    const float lengths = dot(one.axis, one.axis) * dot(two.axis, two.axis);
    const bool parallel = dot(normal, normal) < PARALLEL * lengths;  // never with a sphere
    float place, other;
    nearest_places(away, one.axis, two.axis, place, other);
#pragma unroll 1
    for (int end = -1; end <= 1; end += 2) {
      if (parallel) place_of_end(end, away, one.axis, two.axis, place, other);
      Vec3 way = away + other * two.axis - place * one.axis;
      const float gap = normalize(way) - one.radius - two.radius;
      const bool touches = present && gap < 0 && (parallel || end < 0);
      const Vec3 point = one.middle + place * one.axis + (one.radius + 0.5f * gap) * way;
      count = keep(search, count, touches, gap, point, way, row.pair);
      if (!lanes_where(parallel && present)) break;
    }
  }
  return count;
}
