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

DEV Vec3 row(const Mat3 &m, int axis) { return axis == 0 ? m.x : axis == 1 ? m.y : m.z; }
DEV Vec3 unit(int axis) { return {axis == 0 ? 1.0f : 0.0f, axis == 1 ? 1.0f : 0.0f, axis == 2 ? 1.0f : 0.0f}; }
DEV Vec3 without(Vec3 a, int axis) { return {axis == 0 ? 0 : a.x, axis == 1 ? 0 : a.y, axis == 2 ? 0 : a.z}; }
DEV Vec3 signed_like(Vec3 a, Vec3 signs) {
  return {copysignf(a.x, signs.x), copysignf(a.y, signs.y), copysignf(a.z, signs.z)};
}
DEV Mat3 transposed(const Mat3 &m) { return {column(m, 0), column(m, 1), column(m, 2)}; }
DEV int next(int axis) { return axis == 2 ? 0 : axis + 1; }
DEV int greatest(Vec3 a) { return a.x >= a.y && a.x >= a.z ? 0 : a.y >= a.z ? 1 : 2; }

// An axis of separation of each lane, in the frame of the first box: 0-2 and 3-5 faces, 6-14 edges.
struct Axis {
  Vec3 way;
  int mine, theirs;  // edges
  float sine2;       // of the angle between the edges, squared
  float gap;         // m, between the boxes along it
};

DEV Axis axis_of_lane(int lane, const Mat3 &turn, Vec3 offset, Vec3 half, Vec3 other) {
  Axis axis;
  axis.mine = lane < 6 ? lane % 3 : (lane - 6) / 3 % 3;
  axis.theirs = lane % 3;
  const Vec3 mine = unit(axis.mine), theirs = column(turn, axis.theirs);
  axis.way = lane < 3 ? mine : lane < 6 ? theirs : cross(mine, theirs);
  axis.sine2 = dot(axis.way, axis.way);
  normalize(axis.way);
  axis.gap = fabsf(dot(axis.way, offset)) - dot(absolute(axis.way), half) -
             dot(absolute(transposed_times(turn, axis.way)), other);
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
DEV float edge_contact(Axis &axis, const Mat3 &turn, Vec3 offset, Vec3 half, Vec3 other, Vec3 &point) {
  if (dot(axis.way, offset) < 0) axis.way = -axis.way;
  // The edges that reach farthest toward the other box.
  const Vec3 mine = without(signed_like(half, axis.way), axis.mine);
  const Vec3 theirs = without(signed_like(other, -transposed_times(turn, axis.way)), axis.theirs);
  const Vec3 along = column(turn, axis.theirs), away = offset + turn * theirs - mine;
  const float share = pick(along, axis.mine), ahead = pick(away, axis.mine), behind = dot(along, away);
  const float reach = pick(half, axis.mine), far = pick(other, axis.theirs);
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

DEV Faces faces(const Mat3 &turn, Vec3 offset, Vec3 half, Vec3 other, int face, float side) {
  const int x = next(face), y = next(x);
  const Mat3 axes = {row(turn, x), row(turn, y), side * row(turn, face)};  // columns: axes of the incident box
  const Vec3 middle = {pick(offset, x), pick(offset, y), side * pick(offset, face) - pick(half, face)};
  const int down = greatest(absolute(axes.z)), u = next(down), v = next(u);
  const Vec3 normal = column(axes, down);
  const float depth = normal.z > 0 ? -pick(other, down) : pick(other, down);
  return {pick(half, x),
          pick(half, y),
          middle + depth * normal,
          pick(other, u) * column(axes, u),
          pick(other, v) * column(axes, v),
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
DEV int box_on_box(const Search &search, int count, const Solid &one, const Solid &two, int pair) {
  const Mat3 turn = transposed(one.rotation) * two.rotation;  // columns: axes of the second in the first
  const Vec3 offset = in_frame(one, two.place);
  Axis axis = axis_of_lane(search.lane, turn, offset, one.size, two.size);
  const bool flat = search.lane < 6;
  const float face = greatest_of_lanes(flat ? axis.gap : NOT_AN_AXIS);
  const float edge = greatest_of_lanes(flat ? NOT_AN_AXIS : axis.gap);
  if (fmaxf(face, edge) >= 0) return count;
  const int flattest = __ffs(lanes_where(flat && axis.gap == face)) - 1;
  const int sharpest = __ffs(lanes_where(!flat && axis.gap == edge)) - 1;
  if (edges_meet(edge, face, axis.way, sharpest, flattest)) {
    Vec3 point;
    const float gap = edge_contact(axis, turn, offset, one.size, two.size, point);
    return keep(search, count, search.lane == sharpest && gap < 0, gap,
                one.place + one.rotation * point, one.rotation * axis.way, pair);
  }
  const bool first = flattest < 3;  // whose face is the reference
  const int reference = first ? flattest : flattest - 3;
  const Solid base = first ? one : two;
  const Vec3 to_other = first ? offset : -transposed_times(turn, offset);
  const float side = pick(to_other, reference) >= 0 ? 1.0f : -1.0f;
  const Faces both =
      faces(first ? turn : transposed(turn), to_other, base.size, first ? two.size : one.size, reference, side);
  Vec3 corner;
  const bool touches = corner_over_face(both, search.lane, corner) && corner.z < 0;
  // Midway between the faces.
  const int x = next(reference), y = next(x);
  const Vec3 normal = side * column(base.rotation, reference);
  const Vec3 point = base.place + (pick(base.size, reference) + 0.5f * corner.z) * normal +
                     corner.x * column(base.rotation, x) + corner.y * column(base.rotation, y);
  return keep(search, count, touches, corner.z, point, first ? normal : -normal, pair);
}

DEV Solid box_geom(const Search &search, int index) {
  const BoxGeom &geom = BOX_GEOM[index];
  const Pose &pose = search.shared.pose[geom.link];
  const Vec3 half = geom.size < 0 ? geom.half : geom_size(search, geom.size);
  return {pose.rotation * geom.rotation, in_world(pose, geom.place), half};
}

DEV int boxes_meet(const Search &search, int count) {
  constexpr int PAIRS = BOXES * BOX_PRIMITIVES, EACH = PAIRS ? BOX_PRIMITIVES : 1;
#pragma unroll 1
  for (int first = 0; first < PAIRS; first += 32) {
    // The sphere round a box of the object against the box of the hand: a pair a lane.
    const int index = smaller(first + search.lane, PAIRS - 1);
    const Solid mine = box_geom(search, index / EACH);
    const Solid &theirs = search.primitives[FIRST_BOX + index % EACH];
    Vec3 outward;
    const float apart = distance(Box{}, in_frame(mine, theirs.place), mine.size, outward);
    unsigned near = lanes_where(first + search.lane < PAIRS && apart < length(theirs.size));
#pragma unroll 1
    for (; near; near &= near - 1) {
      const int pair = first + __ffs(near) - 1, box = pair / EACH, primitive = pair % EACH;
      count = box_on_box(search, count, box_geom(search, box), search.primitives[FIRST_BOX + primitive],
                         OBJECT_PAIR[FIRST_BOX + primitive][FIRST_BOX_GEOM + box]);
    }
  }
  return count;
}
