// What every search for contacts needs: where things are, and a place for what is found.
#pragma once
#include "shared.cuh"

struct __align__(16) Solid {
  Mat3 rotation;
  Vec3 place;
  Vec3 size;  // m, as MuJoCo has it
};

struct Search {
  const Args &args;
  Shared &shared;
  Solid *primitives;  // of the object, in the world; behind them free memory
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

// A world's own size of a geom of the hand.
DEV Vec3 geom_size(const Search &search, int row) {
  return load3(search.args.geom_size + (search.world * (PRIMITIVES + TIP_GEOMS) + row) * 3);
}

// The object's primitives, one a lane, to where all lanes can read them.
DEV void place_primitives(const Args &args, int world, const Mat3 &rotation, Vec3 place, int lane, Solid *primitives) {
#pragma unroll 1
  for (int primitive = lane; primitive < PRIMITIVES; primitive += 32) {
    const int row = world * PRIMITIVES + primitive;
    const float *size = args.geom_size + (world * (PRIMITIVES + TIP_GEOMS) + primitive) * 3;
    const float *quat = args.geom_quat + row * 4;
    const Mat3 turn = TURNED_PRIMITIVES ? rotation * rotation_of(quat[0], quat[1], quat[2], quat[3]) : rotation;
    primitives[primitive] = {turn, place + rotation * load3(args.geom_pos + row * 3), load3(size)};
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
  if (touches && slot < MAX_CONTACTS) {
    Contact &contact = search.shared.contact[slot];
    contact.gap = gap;
    contact.point = point;
    contact.normal = normal;
    contact.pair = pair;
  }
  return count + __popc(lanes);
}
