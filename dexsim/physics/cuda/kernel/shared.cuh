// Who the lanes of a world's warp are, and what they share: one `Shared` in shared memory for each warp.
//
// Of the scene (scene.py): HINGES of the hand, CHAIN (hinges from the palm to a link at most), BLOCK (hinges of a finger,
// 0 where the hand is not made of short fingers), MAX_CONTACTS.
#pragma once
#include "warp.cuh"

constexpr int DOFS = HINGES + 6;
constexpr int GROUPS = (32 - HINGES) / 6;  // of six lanes for the object, which share its contacts

// Columns of a contact's Jacobian: the hinges that carry its first link, then the object's six degrees of freedom or the
// hinges that carry its second link.
constexpr int OTHER = CHAIN > 6 ? CHAIN : 6;
constexpr int COLUMNS = CHAIN + OTHER;

// A row of the hand's linear system: six columns of the object, right-hand side, inverse of the pivot, then the columns
// of the hand. In float4s.
constexpr int ROW = 2 + (HINGES + 3) / 4;

constexpr int MASS_STRIDE = HINGES | 1;  // odd: lanes that each read their own row meet in no bank of shared memory

struct Contact {
  float gap;    // m, negative
  Vec3 point;   // m, in the world
  Vec3 normal;  // from the pair's first geom to its second
  int pair;     // of the MjModel
};

struct Pose {
  Mat3 rotation;
  Vec3 place;
  float unused;  // an odd stride, as above
};

// Motions and forces are spatial vectors at the world's origin: angular first.
struct Motion {
  Vec3 turn, shift;
};

struct __align__(16) Shared {
  float4 factor[MAX_CONTACTS * COLUMNS];  // by contact and column: factor of the Hessian (x, y, z), gradient (w);
                                          // free for other use before the solver (`scratch`)
  float4 hand[HINGES * ROW];              // the hand's linear system while it is eliminated
  float4 object[6 * 2];                   // what remains for the object: 6 x 6, right-hand side
  Contact contact[MAX_CONTACTS];
  Pose pose[HINGES + 1];                  // of the links in the world; the last is the palm: the identity
  float motion[DOFS * 7];                 // of a unit velocity of each degree of freedom
  float vector[DOFS];                     // one number for each degree of freedom: velocity, acceleration, step
  float mass[BLOCK ? 1 : HINGES * MASS_STRIDE];
};

// Memory that is free while contacts are found.
DEV float *scratch(Shared &shared) { return (float *)shared.factor; }
constexpr int SCRATCH = MAX_CONTACTS * COLUMNS * 4;
static_assert(SCRATCH >= HINGES * MASS_STRIDE, "the mass matrix of the hand fits");

// The mass matrix of the hand [HINGES][MASS_STRIDE]: kept in shared memory only where registers do not hold its rows.
DEV float *mass_rows(Shared &shared) { return BLOCK ? scratch(shared) : shared.mass; }

DEV Motion motion_of(const Shared &shared, int dof) {
  const float *from = shared.motion + 7 * dof;
  return {load3(from), load3(from + 3)};
}

// Which degree of freedom a lane has.
struct Lane {
  int index;
  bool hinge;   // of the hand, its hinge `index`
  bool object;  // one of the object's six, repeated in GROUPS
  bool dof;     // hinge, or object in the first group
  int axis;     // of the object's six
  int group;
  int parent;   // lane of the hinge that carries this one's, or any if there is none
  int depth;    // hinges between it and the palm: the column of a contact's Jacobian
  int first;    // hinge of its finger
  unsigned finger;  // lanes of its finger's hinges
};

DEV Lane lane_of(int index) {
  Lane lane;
  lane.index = index;
  lane.hinge = index < HINGES;
  lane.object = !lane.hinge && index < HINGES + 6 * GROUPS;
  lane.dof = index < DOFS;
  lane.axis = lane.hinge ? 0 : (index - HINGES) % 6;
  lane.group = lane.hinge ? 0 : (index - HINGES) / 6;
  lane.parent = PARENT[index] < 0 ? index : PARENT[index];
  lane.depth = DEPTH[index];
  lane.first = BLOCK_FIRST[index];
  lane.finger = (2u << BLOCK_LAST[index]) - (1u << lane.first);
  return lane;
}

// What moves: a hinge a lane, and the object on all lanes.
struct State {
  float angle, speed;        // rad, rad/s
  Vec3 place;                // m
  float w, x, y, z;          // unit quaternion
  Vec3 velocity, spin;       // m/s in the world, rad/s in the object's frame
  float acceleration;        // of the lane's degree of freedom: the last, the solver's first guess
};
