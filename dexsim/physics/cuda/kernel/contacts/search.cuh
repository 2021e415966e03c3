// What every search for contacts needs: where things are, and a place for what is found.
#pragma once
#include "shared.cuh"

struct Search {
  const Args &args;
  Shared &shared;
  Mat3 rotation;  // of the object
  Vec3 place;
  int world, lane;
};

struct Frame {
  Mat3 rotation;
  Vec3 place;
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

DEV Vec3 geom_size(const Search &search, int row) {
  return load3(search.args.geom_size + (search.world * (PRIMITIVES + TIP_GEOMS) + row) * 3);
}

// A primitive of the object in the world.
DEV Frame primitive_frame(const Search &search, int primitive) {
  const int row = search.world * PRIMITIVES + primitive;
  Frame frame = {search.rotation, search.place + search.rotation * load3(search.args.geom_pos + row * 3)};
  if (TURNED_PRIMITIVES) {
    const float *quat = search.args.geom_quat + row * 4;
    frame.rotation = search.rotation * rotation_of(quat[0], quat[1], quat[2], quat[3]);
  }
  return frame;
}

DEV Vec3 in_frame(const Frame &frame, Vec3 point) { return transposed_times(frame.rotation, point - frame.place); }

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
