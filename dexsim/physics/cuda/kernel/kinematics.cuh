// Where the links are, and how they move: one link a lane, the object on the lanes after the hinges.
#pragma once
#include "shared.cuh"

struct Force {
  Vec3 moment, force;
};

// Inertia about the world's origin.
struct Inertia {
  float mass;
  Vec3 moment;  // mass times centre of mass
  float xx, xy, xz, yy, yz, zz;
};

DEV float dot(const Motion &a, const Force &b) { return dot(a.turn, b.moment) + dot(a.shift, b.force); }
DEV Motion from_lane(const Motion &a, int lane) { return {from_lane(a.turn, lane), from_lane(a.shift, lane)}; }
DEV Force from_lane(const Force &a, int lane) { return {from_lane(a.moment, lane), from_lane(a.force, lane)}; }
DEV Motion operator+(const Motion &a, const Motion &b) { return {a.turn + b.turn, a.shift + b.shift}; }
DEV Force operator+(const Force &a, const Force &b) { return {a.moment + b.moment, a.force + b.force}; }
DEV Motion operator*(float s, const Motion &a) { return {s * a.turn, s * a.shift}; }

DEV Inertia from_lane(const Inertia &a, int lane) {
  return {from_lane(a.mass, lane), from_lane(a.moment, lane), from_lane(a.xx, lane), from_lane(a.xy, lane),
          from_lane(a.xz, lane),   from_lane(a.yy, lane),     from_lane(a.yz, lane), from_lane(a.zz, lane)};
}
DEV Inertia operator+(const Inertia &a, const Inertia &b) {
  return {a.mass + b.mass, a.moment + b.moment, a.xx + b.xx, a.xy + b.xy,
          a.xz + b.xz,     a.yy + b.yy,         a.yz + b.yz, a.zz + b.zz};
}
DEV Force operator*(const Inertia &i, const Motion &v) {
  const Vec3 turned = {i.xx * v.turn.x + i.xy * v.turn.y + i.xz * v.turn.z,
                       i.xy * v.turn.x + i.yy * v.turn.y + i.yz * v.turn.z,
                       i.xz * v.turn.x + i.yz * v.turn.y + i.zz * v.turn.z};
  return {turned + cross(i.moment, v.shift), i.mass * v.shift + cross(v.turn, i.moment)};
}

// Adds to each link's motion those of all links that carry it, from the palm outwards.
DEV void add_parents(Motion &motion, const Lane &lane) {
#pragma unroll 1
  for (int depth = 1; depth < CHAIN; depth++) {
    const Motion above = from_lane(motion, lane.parent);
    if (lane.depth == depth) motion = motion + above;
  }
}

// Adds to each link's value those of all links that it carries, in a fixed order (scene.py, `Links.gathering`).
template <class T> DEV void add_children(T &value, const Lane &lane) {
#pragma unroll 1
  for (int step = 0; step < GATHER_STEPS; step++) {
    const int child = GATHER_FROM[step][lane.index];
    const T below = from_lane(value, child < 0 ? lane.index : child);
    if (child >= 0) value = value + below;
  }
}

DEV Vec3 lane_vector(const float (&rows)[3][32], int lane) { return {rows[0][lane], rows[1][lane], rows[2][lane]}; }

// Rotation and place of the lane's link in the world to `shared.pose`.
DEV void place_links(const State &state, Shared &shared, const Lane &lane) {
  Pose pose = {{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}, {0, 0, 0}, 0};
  if (lane.hinge) {
    float s, c;
    sincosf(state.angle, &s, &c);
    const int l = lane.index;
    // The offset in the parent's frame, then a rotation about z: the first two columns mix.
    const Vec3 x = {OFFSET_ROTATION[0][l], OFFSET_ROTATION[3][l], OFFSET_ROTATION[6][l]};
    const Vec3 y = {OFFSET_ROTATION[1][l], OFFSET_ROTATION[4][l], OFFSET_ROTATION[7][l]};
    const Vec3 u = c * x + s * y, v = c * y - s * x;
    const Vec3 z = {OFFSET_ROTATION[2][l], OFFSET_ROTATION[5][l], OFFSET_ROTATION[8][l]};
    pose.rotation = {{u.x, v.x, z.x}, {u.y, v.y, z.y}, {u.z, v.z, z.z}};
    pose.place = lane_vector(OFFSET_PLACE, l);
  }
#pragma unroll 1
  for (int depth = 1; depth < CHAIN; depth++) {
    const Mat3 turn = from_lane(pose.rotation, lane.parent);
    const Vec3 origin = from_lane(pose.place, lane.parent);
    if (lane.depth == depth) {
      pose.rotation = turn * pose.rotation;
      pose.place = origin + turn * pose.place;
    }
  }
  if (lane.index <= HINGES) shared.pose[lane.index] = pose;  // the last is the palm's
  __syncwarp();
}

// The pose of the lane's link, or of the object.
DEV Pose pose_of(const State &state, const Mat3 &object, const Shared &shared, const Lane &lane) {
  if (lane.hinge) return shared.pose[lane.index];
  return {object, state.place, 0};
}

// What a unit velocity of the lane's degree of freedom moves: a hinge turns about its link's z axis; the object is
// moved along the world's axes and turned about its own, as MuJoCo's free joint.
DEV Motion unit_motion(const Pose &pose, Shared &shared, const Lane &lane) {
  const int axis = lane.hinge ? 2 : lane.axis - 3;
  Motion motion;
  motion.turn = column(pose.rotation, axis);
  motion.shift = cross(pose.place, motion.turn);
  if (!lane.hinge && axis < 0) motion = {{0, 0, 0}, {float(axis == -3), float(axis == -2), float(axis == -1)}};
  if (lane.dof) {
    float *to = shared.motion + 7 * lane.index;
    to[0] = motion.turn.x, to[1] = motion.turn.y, to[2] = motion.turn.z;
    to[3] = motion.shift.x, to[4] = motion.shift.y, to[5] = motion.shift.z;
  }
  return motion;
}
