// Boxes of the hand (a palm) on boxes of the object, with the points of C MuJoCo.
//
// Two boxes are apart, or overlap least, along one of fifteen axes: the normals of three faces of each, and what is
// across an edge of the one and an edge of the other. Along a normal its face, the reference, meets that face of the
// other box which is most opposed to it, the incident face: every corner of the part of that face which lies over the
// reference is a contact. Along the others the two edges meet in one contact. A candidate a lane.
#pragma once
#include "contacts/primitives.cuh"

constexpr float NOT_AN_AXIS = -1e10f;
// Squared sine of the angle between edges below which what is across them is rounding error; faces cover it then.
constexpr float PARALLEL_EDGES = 1e-8f;

// Two boxes in shared memory, where an index that differs between lanes costs nothing.
struct BoxPair {
  const Solid &hand, &object;
  float4 *turn;      // 3 rows: axes of the hand's box in the frame of the object's; last column: the object's place
  float4 *to_first;  // the hand's place in the frame of the object's
};

// An element of what lies in shared memory.
DEV float at(const float4 &row, int column) { return (&row.x)[column]; }
DEV float at(const Vec3 &vector, int axis) { return (&vector.x)[axis]; }
DEV Vec3 axis_of(const Solid &solid, int axis) {
  return {at(solid.rotation.x, axis), at(solid.rotation.y, axis), at(solid.rotation.z, axis)};
}

DEV Vec3 unit(int axis) { return {axis == 0 ? 1.0f : 0.0f, axis == 1 ? 1.0f : 0.0f, axis == 2 ? 1.0f : 0.0f}; }
DEV Vec3 without(Vec3 a, int axis) { return {axis == 0 ? 0 : a.x, axis == 1 ? 0 : a.y, axis == 2 ? 0 : a.z}; }
DEV Vec3 signed_like(Vec3 a, Vec3 signs) {
  return {copysignf(a.x, signs.x), copysignf(a.y, signs.y), copysignf(a.z, signs.z)};
}
DEV int next(int axis) { return axis == 2 ? 0 : axis + 1; }
DEV int greatest(Vec3 a) { return a.x >= a.y && a.x >= a.z ? 0 : a.y >= a.z ? 1 : 2; }

// The relative pose of two boxes: an element a lane.
DEV void write_relative(const BoxPair &pair, int lane) {
  const Vec3 away = pair.object.place - pair.hand.place;
  if (lane < 15) {
    const int column = lane < 12 ? lane & 3 : 3;
    const Vec3 axis = lane < 12 ? axis_of(pair.hand, lane >> 2) : -axis_of(pair.object, lane - 12);
    (&pair.turn[0].x)[lane] = dot(axis, column < 3 ? axis_of(pair.object, column) : away);
  }
  __syncwarp();
}

DEV Mat3 turn_of(const BoxPair &pair) {
  const float4 x = pair.turn[0], y = pair.turn[1], z = pair.turn[2];
  return {{x.x, x.y, x.z}, {y.x, y.y, y.z}, {z.x, z.y, z.z}};
}

DEV Vec3 offset_of(const BoxPair &pair) { return {pair.turn[0].w, pair.turn[1].w, pair.turn[2].w}; }

// An axis of separation of each lane, in the frame of the first box: 0-2 and 3-5 faces, 6-14 edges.
struct Axis {
  Vec3 way;
  int mine, theirs;  // edges
  float sine2;       // of the angle between the edges, squared
  float gap;         // m, between the boxes along it
};

DEV Axis axis_of_lane(const BoxPair &pair, const Mat3 &turn, int lane) {
  Axis axis;
  axis.theirs = lane % 3;
  axis.mine = lane < 6 ? axis.theirs : smaller((lane - 6) / 3, 2);
  const Vec3 mine = unit(axis.mine);
  const Vec3 theirs = {at(pair.turn[0], axis.theirs), at(pair.turn[1], axis.theirs), at(pair.turn[2], axis.theirs)};
  axis.way = lane < 3 ? mine : lane < 6 ? theirs : cross(mine, theirs);
  axis.sine2 = dot(axis.way, axis.way);
  normalize(axis.way);
  axis.gap = fabsf(dot(axis.way, offset_of(pair))) - dot(absolute(axis.way), pair.hand.size) -
             dot(absolute(transposed_times(turn, axis.way)), pair.object.size);
  if (lane >= 15 || axis.sine2 < PARALLEL_EDGES) axis.gap = NOT_AN_AXIS;
  return axis;
}

// Whether the edges' axis `edge` counts, of lane `sharpest`, and not the faces' `face` of lane `flattest`.
DEV bool edges_meet(float edge, float face, Vec3 way, int sharpest, int flattest) {
  if (edge - 1e-6f * fabsf(edge) <= face) return false;
  // An axis that is nearly a face's has to be better by 5 %: a face has more points, and steady ones.
  const bool alike = fabsf(dot(from_lane(way, sharpest), from_lane(way, flattest))) > 0.99f;
  return !(alike && edge < face + 0.05f * fabsf(face));
}

// Where this lane's edges pass each other, and their distance along the axis, in the frame of the first box.
DEV float edge_contact(Axis &axis, const BoxPair &pair, const Mat3 &turn, Vec3 &point) {
  const Vec3 offset = offset_of(pair);
  if (dot(axis.way, offset) < 0) axis.way = -axis.way;
  // The edges that reach farthest toward the other box.
  const Vec3 mine = without(signed_like(pair.hand.size, axis.way), axis.mine);
  const Vec3 theirs = without(signed_like(pair.object.size, -transposed_times(turn, axis.way)), axis.theirs);
  const Vec3 along = column(turn, axis.theirs), away = offset + turn * theirs - mine;
  const float share = pick(along, axis.mine), ahead = pick(away, axis.mine), behind = dot(along, away);
  const float reach = at(pair.hand.size, axis.mine), far = at(pair.object.size, axis.theirs);
  float place = clamp((ahead - share * behind) / axis.sine2, -reach, reach);
  const float there = clamp(share * place - behind, -far, far);
  place = clamp(ahead + share * there, -reach, reach);
  const Vec3 one = mine + place * unit(axis.mine), two = mine + away + there * along;
  point = 0.5f * (one + two);
  return dot(two - one, axis.way);
}

// The reference face in its own frame (x and y along it, z outward, origin in its middle) and the incident face there.
struct Faces {
  float wide, deep;           // m, halves of the reference face
  Vec3 middle, across, upon;  // of the incident face: middle, halves of two edges
  Vec3 normal;                // unit
};

// Face `face` of the first box (the hand's) or the second, on `side` of it.
DEV Faces faces(const BoxPair &pair, bool first, int face, float side) {
  const Solid &base = first ? pair.hand : pair.object, &other = first ? pair.object : pair.hand;
  const float *turn = &pair.turn->x, *to_other = first ? turn + 3 : &pair.to_first->x;
  const int row = first ? 4 : 1, column = first ? 1 : 4;  // from axis to axis of the reference box, of the other one
  const int x = next(face), y = next(x);
  auto axis = [&](int of_other) -> Vec3 {
    const float *from = turn + column * of_other;
    return {from[row * x], from[row * y], side * from[row * face]};
  };
  const Vec3 one = axis(0), two = axis(1), three = axis(2);
  const int down = greatest({fabsf(one.z), fabsf(two.z), fabsf(three.z)}), u = next(down), v = next(u);
  const Vec3 normal = axis(down), middle = {to_other[row * x], to_other[row * y], side * to_other[row * face]};
  const float depth = copysignf(at(other.size, down), -normal.z);
  return {at(base.size, x),
          at(base.size, y),
          middle + depth * normal - Vec3{0, 0, at(base.size, face)},
          at(other.size, u) * axis(u),
          at(other.size, v) * axis(v),
          normal};
}

// One corner of the part of the incident face that lies over the reference face: of lanes 0-3 where an edge of the
// incident face begins to, of lanes 4-7 where it ends, of lanes 8-11 a corner of the reference face.
DEV bool corner_over_face(const Faces &faces, int lane, Vec3 &corner) {
  const int q = lane & 3;
  const float x = q == 0 || q == 3 ? 1.0f : -1.0f, y = q < 2 ? 1.0f : -1.0f;  // round the face
  if (lane < 8) {
    // From this corner to the next: along x for q = 0 and 2, else along y.
    const Vec3 start = faces.middle + x * faces.across + y * faces.upon;
    const Vec3 way = q & 1 ? (-2 * y) * faces.upon : (-2 * x) * faces.across;
    const float run_x = fabsf(way.x) < 1e-9f ? 1e-9f : way.x, run_y = fabsf(way.y) < 1e-9f ? 1e-9f : way.y;
    const float x1 = (-faces.wide - start.x) / run_x, x2 = (faces.wide - start.x) / run_x;
    const float y1 = (-faces.deep - start.y) / run_y, y2 = (faces.deep - start.y) / run_y;
    const float begin = fmaxf(fmaxf(fminf(x1, x2), fminf(y1, y2)), 0.0f);
    const float end = fminf(fminf(fmaxf(x1, x2), fmaxf(y1, y2)), 1.0f);
    corner = start + (lane < 4 ? begin : end) * way;
    // An edge that ends over the face ends where the next one begins.
    return begin <= end && (lane < 4 || end < 1);
  }
  const float steep = fabsf(faces.normal.z) < 1e-6f ? 1e-6f : faces.normal.z;
  corner = {x * faces.wide, y * faces.deep, 0};
  const Vec3 flat = corner - faces.middle;
  corner.z = faces.middle.z - (flat.x * faces.normal.x + flat.y * faces.normal.y) / steep;
  const Vec3 inside = corner - faces.middle;
  return lane < 12 && fabsf(dot(inside, faces.across)) < dot(faces.across, faces.across) &&
         fabsf(dot(inside, faces.upon)) < dot(faces.upon, faces.upon);
}

// All lanes on one pair of boxes.
DEV int box_on_box(const Search &search, int count, const BoxPair &pair, int id) {
  const Mat3 turn = turn_of(pair);
  Axis axis = axis_of_lane(pair, turn, search.lane);
  const bool flat = search.lane < 6;
  const float face = greatest_of_lanes(flat ? axis.gap : NOT_AN_AXIS);
  const float edge = greatest_of_lanes(flat ? NOT_AN_AXIS : axis.gap);
  if (fmaxf(face, edge) >= 0) return count;
  const int flattest = __ffs(lanes_where(flat && axis.gap == face)) - 1;
  const int sharpest = __ffs(lanes_where(!flat && axis.gap == edge)) - 1;
  Vec3 point, normal;
  float gap;
  bool touches;
  if (edges_meet(edge, face, axis.way, sharpest, flattest)) {
    gap = edge_contact(axis, pair, turn, point);
    touches = search.lane == sharpest;
    point = pair.hand.place + pair.hand.rotation * point;
    normal = pair.hand.rotation * axis.way;
  } else {
    const bool first = flattest < 3;  // whose face is the reference
    const int reference = first ? flattest : flattest - 3;
    const Solid &base = first ? pair.hand : pair.object;
    const float side = copysignf(1.0f, first ? at(pair.turn[reference], 3) : at(*pair.to_first, reference));
    Vec3 corner;
    touches = corner_over_face(faces(pair, first, reference, side), search.lane, corner);
    gap = corner.z;
    // Midway between the faces.
    const int x = next(reference), y = next(x);
    normal = side * axis_of(base, reference);
    point = base.place + corner.x * axis_of(base, x) + corner.y * axis_of(base, y) +
            (at(base.size, reference) + 0.5f * gap) * normal;
    if (!first) normal = -normal;
  }
  return keep(search, count, touches && gap < 0, gap, point, normal, id);
}

DEV Solid box_geom(const Search &search, int index) {
  const BoxGeom &geom = BOX_GEOM[index];
  const Pose &pose = search.shared.pose[geom.link];
  const Vec3 half = geom.size < 0 ? geom.half : geom_size(search, geom.size);
  return {pose.rotation * geom.rotation, in_world(pose, geom.place), half};
}

DEV int boxes_meet(const Search &search, int count) {
  Found &found = search.found;
#pragma unroll 1
  for (int box = 0; box < BOXES; box++) {
    if (search.lane == 0) found.box = box_geom(search, box);
    __syncwarp();
#pragma unroll 1
    for (int first = 0; first < BOX_PRIMITIVES; first += 32) {
      // The spheres round boxes of the object against the box of the hand: one a lane.
      const Solid &other = found.primitives[FIRST_BOX + smaller(first + search.lane, BOX_PRIMITIVES - 1)];
      Vec3 outward;
      const float apart = distance(Box{}, in_frame(found.box, other.place), found.box.size, outward);
      unsigned near = lanes_where(first + search.lane < BOX_PRIMITIVES && apart < length(other.size));
#pragma unroll 1
      for (; near; near &= near - 1) {
        const int primitive = FIRST_BOX + first + __ffs(near) - 1;
        const BoxPair pair = {found.box, found.primitives[primitive], found.relative, found.relative + 3};
        write_relative(pair, search.lane);
        count = box_on_box(search, count, pair, OBJECT_PAIR[primitive][FIRST_BOX_GEOM + box]);
        __syncwarp();
      }
    }
  }
  return count;
}
