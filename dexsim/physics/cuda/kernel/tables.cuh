// Rows of the tables that scene.py prints.
#pragma once
#include "warp.cuh"

// A joint that follows another: q - q0 = polynomial of (q' - q0').
struct Coupling {
  int first, second;
  float zero[2], polynomial[5], spring[7], compliance;
};

// Two bodies that touch.
struct Pair {
  int first, second;  // links, the object's last
  int row;            // among the object's pairs, or -1 - that among the others
  int finger;         // whose tip presses on the object
  float side;         // -1 where the object is the pair's first
  float compliance;   // 1/kg, inverse weights of both bodies
};

// Geoms of the hand in the frames of their links.

// A sphere, or a capsule: the ball that is swept along an axis.
struct __align__(16) RoundGeom {
  Vec3 place;      // m
  int link;        // HINGES: fixed to the palm
  Vec3 half_axis;  // m, from the middle to an end; zero of a sphere
  float radius;    // m
  int size;        // where the world's own size is among `geom_size`; -1: the same in all worlds
};

struct __align__(16) BoxGeom {
  Vec3 place;
  int link;
  Mat3 rotation;
  Vec3 half;  // m
  int size;
};

// MuJoCo has planes only where nothing moves: in the world.
struct PlaneGeom {
  Vec3 place, normal;
};

// A place of a primitive of the object that may be the lowest over a plane.
struct PlanePoint {
  int plane, primitive, kind, corner;
};

// Two capsules or spheres: geoms of the hand, or of the hand and (-1 - primitive) of the object.
struct RoundPair {
  int first, second, pair;
};
