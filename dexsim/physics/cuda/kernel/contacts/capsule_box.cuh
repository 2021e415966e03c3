// Where a capsule meets a box: C MuJoCo's two places.
//
// The one is the axis' nearest point to the box, the other the end of that part of the axis which is over the same
// face. Four lanes look at a capsule: each at one edge of the box along every axis, two also at the axis' ends.
#pragma once
#include "contacts/primitives.cuh"

DEV Vec3 rolled(Vec3 a) { return {a.y, a.z, a.x}; }
DEV Vec3 rolled(Vec3 a, int times) { return times == 0 ? a : times == 1 ? rolled(a) : rolled(rolled(a)); }
DEV float sign_of(bool positive) { return positive ? 1.0f : -1.0f; }

// What is nearest to the axis of a capsule so far, among edges of the box and ends of the axis.
struct Nearest {
  float gap;      // m^2
  float place;    // on the axis, -1 to 1
  float along;    // on the edge, -1 to 1
  float end;      // of the edge that bounds it; 0: neither
  int direction;  // along which the edge runs; of an end of the axis: that across the face below (3: inside the box)
  bool tip;       // an end of the axis
};

// The edge that runs along x on side (y, z): what it and the axis have nearest to each other.
DEV void try_edge(Vec3 start, Vec3 axis, Vec3 size, Vec3 side, int direction, Nearest &best) {
  const Vec3 away = Vec3{0, side.y * size.y, side.z * size.z} - start;
  const float a = size.x * size.x, b = -size.x * axis.x, c = dot(axis, axis);
  const float u = -size.x * away.x, v = dot(away, axis);
  const float square = axis.y * axis.y + axis.z * axis.z;
  if (a * square < 1e-15f) return;  // parallel, as C MuJoCo has it: the ends of this edge are those of others
  // Seen along the edge, the lines are nearest where the axis passes it.
  float place = (away.y * axis.y + away.z * axis.z) / square, along = (place * axis.x - away.x) / size.x, end = 0;
  // Beyond an end of the edge, what is nearest to that end; beyond the axis' end, what is nearest to it.
  // The end of the edge counts as in C MuJoCo: also where the end of the axis then leads away from it again.
  if (fabsf(along) > 1) {
    end = copysignf(1.0f, along);
    place = (v - end * b) / c;
    along = end;
  }
  if (fabsf(place) > 1) {
    place = copysignf(1.0f, place);
    along = (u - place * b) / a;
    if (fabsf(along) > 1) end = along = copysignf(1.0f, along);
  }
  const Vec3 apart = away - place * axis + Vec3{size.x * along, 0, 0};
  const float gap = dot(apart, apart);
  if (gap < best.gap) best = {gap, place, along, end, direction, false};
}

// An end of the axis over a face, or inside the box.
DEV void try_tip(Vec3 start, Vec3 axis, Vec3 size, float place, Nearest &best) {
  const Vec3 tip = absolute(start + place * axis) - size;
  const Vec3 beyond = {fmaxf(tip.x, 0.0f), fmaxf(tip.y, 0.0f), fmaxf(tip.z, 0.0f)};
  const float gap = dot(beyond, beyond);
  const int sides = (tip.x > 0) + (tip.y > 0) + (tip.z > 0);
  const int face = tip.x > 0 ? 0 : tip.y > 0 ? 1 : tip.z > 0 ? 2 : 3;
  // Of ends and edges that are equally near the end counts.
  if (sides <= 1 && gap <= best.gap + 1e-12f) best = {gap - 1e-12f, place, 0, 0, face, true};
}

// The step along the axis from its end over a face to the face's rim, at most to the other end.
DEV float step_over_face(Vec3 start, Vec3 axis, Vec3 size, const Nearest &best) {
  float room = 2;
#pragma unroll 1
  for (int k = 0; k < 3; k++) {
    const float way = -best.place * axis.x, from = start.x + best.place * axis.x;
    if (k != best.direction) room = fminf(room, (size.x - copysignf(from, way * from)) / fmaxf(fabsf(way), 1e-9f));
    start = rolled(start), axis = rolled(axis), size = rolled(size);
  }
  return -best.place * room;
}

// The step from a corner, or from the middle of an edge that runs along x.
DEV bool step_from_edge(Vec3 axis, Vec3 size, Vec3 side, const Nearest &best, float &step) {
  const Vec3 ratio = {size.x / fmaxf(fabsf(axis.x), 1e-9f), size.y / fmaxf(fabsf(axis.y), 1e-9f),
                      size.z / fmaxf(fabsf(axis.z), 1e-9f)};  // how often half the axis goes into half the box
  // Along which directions the axis leads away from the corner.
  const bool x = (axis.x > 0) != (best.end > 0), y = (axis.y > 0) != (side.y > 0), z = (axis.z > 0) != (side.z > 0);
  if (best.end == 0) {
    // Over the face to which the capsule leans less.
    const bool steep_y = fabsf(axis.y) > fabsf(axis.z), away = steep_y ? y : z;
    const float way = sign_of(away);
    const float left = (axis.x > 0) == away ? 1 - best.along : 1 + best.along;
    step = way * fminf(fminf(1 - way * best.place, 2 * (steep_y ? ratio.y : ratio.z)), left * ratio.x);
    return y != z;
  }
  const int count = x + y + z;
  const bool one = count == 1;
  const int alone = x == one ? 0 : y == one ? 1 : 2;  // where it leads otherwise than along both others
  const Vec3 turned = rolled(axis, alone), room = rolled(ratio, alone);
  const float way = sign_of(one);
  const bool steep = turned.x * turned.x > 0.5f * dot(axis, axis);
  const float by_edge = fminf(1 - way * best.place, 2 * room.x);
  const float over_face = -fminf(1 + way * best.place, 2 * fminf(room.y, room.z));
  step = way * (steep ? by_edge : over_face);
  return count == 1 || count == 2;
}

// The place on the axis, from -1 to 1, that this lane (`part` of four) looks after, and whether there is one.
DEV bool meeting_place(Box, Vec3 start, Vec3 axis, Vec3 size, int part, int lane, float &place) {
  Vec3 side = {0, sign_of(part & 1), sign_of(part & 2)};
  Nearest best = {1e10f, 0, 0, 0, 0, false};
  Vec3 from = start, along = axis, half = size;
#pragma unroll 1
  for (int direction = 0; direction < 3; direction++) {
    try_edge(from, along, half, side, direction, best);
    from = rolled(from), along = rolled(along), half = rolled(half);
  }
  if (part < 2) try_tip(start, axis, size, sign_of(part), best);
  float least = fminf(best.gap, from_lane(best.gap, lane ^ 1));
  least = fminf(least, from_lane(least, lane ^ 2));
  const int first_lane = lane & ~3;
  const unsigned nearest = lanes_where(best.gap == least) >> first_lane & 15u;
  const int winner = first_lane + __ffs(nearest) - 1;
  float step = 0;
  bool second = false;
  if (lane == winner) {
    if (best.tip) {
      step = step_over_face(start, axis, size, best);
      second = best.direction < 3;
    } else {
      second = step_from_edge(rolled(axis, best.direction), rolled(size, best.direction), side, best, step);
    }
  }
  const float first = from_lane(best.place, winner), onward = from_lane(step, winner);
  const bool both = from_lane((int)second, winner);
  place = part == 0 ? first : first + onward;
  return part == 0 || (part == 1 && both);
}
