// What every search for contacts needs: where things are, and a place for what is found.
#pragma once
#include "shared.cuh"

struct __align__(16) Solid {
  Mat3 rotation;
  Vec3 place;
  Vec3 size;  // m, as MuJoCo has it
};

// While contacts are found, in memory that the solver needs later.
struct Found {
  Contact extra[EXTRA_CONTACTS ? EXTRA_CONTACTS : 1];  // beyond those that a world can have
  Solid primitives[PRIMITIVES];                       // of the object, in the world
  Solid box;                                          // of the hand
  float4 relative[4];                                 // of that box and one of the object, see box_box.cuh
};
static_assert(sizeof(Found) <= SCRATCH * sizeof(float), "the search for contacts fits");

struct Search {
  const Args &args;
  Shared &shared;
  Found &found;
  int world, lane;
};

DEV float length(Vec3 a) { return sqrtf(dot(a, a)); }
DEV float clamp(float value, float low, float high) { return fminf(fmaxf(value, low), high); }
DEV int smaller(int a, int b) { return a < b ? a : b; }

// The length of a vector, which becomes one of length 1 (zero stays zero).
DEV float normalize(Vec3 &a) {
  const float square = dot(a, a), inverse = rsqrtf(fmaxf(square, 1e-30f));
  a = inverse * a;
  return square * inverse;
}

// The sizes that a world has of its own: of primitives, then of geoms of the hand.
DEV Vec3 geom_size(const Search &search, int row) {
  return load3(search.args.geom_size + (search.world * (PRIMITIVES + TIP_GEOMS) + row) * 3);
}

// The object's primitives, one a lane, to where all lanes can read them.
DEV void place_primitives(const Search &search, const Mat3 &rotation, Vec3 place) {
#pragma unroll 1
  for (int primitive = search.lane; primitive < PRIMITIVES; primitive += 32) {
    const int row = search.world * PRIMITIVES + primitive;
    const float *quat = search.args.geom_quat + row * 4;
    const Mat3 turn = rotation * rotation_of(quat[0], quat[1], quat[2], quat[3]);
    const Vec3 middle = place + rotation * load3(search.args.geom_pos + row * 3);
    search.found.primitives[primitive] = {turn, middle, geom_size(search, primitive)};
  }
  __syncwarp();
}

DEV Vec3 in_frame(const Solid &solid, Vec3 point) { return transposed_times(solid.rotation, point - solid.place); }

DEV Vec3 in_world(const Pose &pose, Vec3 point) { return pose.place + pose.rotation * point; }

// Every lane offers one contact: those that touch are kept in the order of the lanes. Returns how many there are now,
// which may be more than fit.
DEV int keep(const Search &search, int count, bool touches, float gap, Vec3 point, Vec3 normal, int pair) {
  const unsigned lanes = lanes_where(touches);
  const int slot = count + __popc(lanes & lanes_before(search.lane));
  if (touches && slot < MAX_CONTACTS + EXTRA_CONTACTS) {
    const bool fits = EXTRA_CONTACTS == 0 || slot < MAX_CONTACTS;
    Contact &contact = fits ? search.shared.contact[slot] : search.found.extra[slot - MAX_CONTACTS];
    contact.gap = gap;
    contact.point = point;
    contact.normal = normal;
    contact.pair = pair;
  }
  return count + __popc(lanes);
}

// Of more contacts than a world can have the deepest stay. Returns how many there are, more than MAX_CONTACTS only
// where not even all of them were looked at.
DEV int keep_deepest(const Search &search, int count) {
  static_assert(EXTRA_CONTACTS == 0 || MAX_CONTACTS == 32, "a contact a lane");
  Contact &mine = search.shared.contact[search.lane];
#pragma unroll 1
  for (int extra = 0; extra < smaller(count - MAX_CONTACTS, EXTRA_CONTACTS); extra++) {
    const Contact &other = search.found.extra[extra];
    const float shallowest = greatest_of_lanes(mine.gap);
    const int lane = __ffs(lanes_where(mine.gap == shallowest)) - 1;
    if (search.lane == lane && other.gap < shallowest) mine = other;
  }
  __syncwarp();
  return count <= MAX_CONTACTS + EXTRA_CONTACTS ? smaller(count, MAX_CONTACTS) : count;
}
