// What the lanes of a world share: one such block of shared memory for each warp.
//
// Of the scene (scene.py): HINGES of the hand, MAX_CONTACTS, CHAIN (hinges from the palm to a link at most).
#pragma once
#include "warp.cuh"

struct Contact {
  float gap;     // m, negative
  Vec3 point;    // m, in the world
  Vec3 normal;   // from the pair's first geom to its second
  int pair;      // of the MjModel
};

struct Pose {
  Mat3 rotation;
  Vec3 place;
  float unused;  // an odd stride: lanes that read or write one link each meet in no bank
};

// Columns of a contact's Jacobian: the hinges that carry its first link, then the object's six degrees of freedom or the
// hinges that carry its second link.
constexpr int OTHER = CHAIN > 6 ? CHAIN : 6;
constexpr int SLOTS = CHAIN + OTHER;
constexpr int DOFS = HINGES + 6;
constexpr int ROW = (HINGES + 7 + 3) / 4;  // float4s of a row of the hand's system: hinges, object, right-hand side

struct __align__(16) Shared {
  float4 factor[MAX_CONTACTS * SLOTS];  // by contact and column: factor of the Hessian (x, y, z), gradient (w);
                                        // free for other use before the solver (`scratch`)
  float4 hand[HINGES * ROW];            // the hand's rows of the system while it is eliminated
  float4 object[6 * 2];                 // what remains for the object: 6 x 6, right-hand side
  Contact contact[MAX_CONTACTS];
  Pose pose[HINGES + 1];                // of the links, in the world; the last is the palm: the identity
  float motion[DOFS * 7];               // by degree of freedom: turn, shift at the world's origin
  float vector[32];                     // velocities, accelerations: one number for each degree of freedom
};

// Memory that is free while contacts are found.
DEV float *scratch(Shared &shared) { return (float *)shared.factor; }
constexpr int SCRATCH = MAX_CONTACTS * SLOTS * 4;
