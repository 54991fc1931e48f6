/* A seven-joint arm for C tests (modified DH parameters of the Panda, twelve spheres), and seeded random numbers. */
#ifndef ARM_H
#define ARM_H

#include <stdint.h>
#include <string.h>

#include "dbk/dbk.h"

/* uniform in [0, 1), by splitmix64 */
static inline double random_uniform(uint64_t *state) {
  uint64_t z = (*state += 0x9E3779B97F4A7C15u);
  z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
  z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
  return (double)((z ^ (z >> 31)) >> 11) * (1.0 / 9007199254740992.0);
}

static inline dbk_real random_between(uint64_t *state, double low, double high) {
  return (dbk_real)(low + (high - low) * random_uniform(state));
}

static inline void arm_model(dbk_model *m) {
  static const double offset[7][3] = {{0, 0, 0.333},       {0, 0, 0}, {0, -0.316, 0}, {0.0825, 0, 0},
                                      {-0.0825, 0.384, 0}, {0, 0, 0}, {0.088, 0, 0}};
  static const int quarter[7] = {0, -1, 1, 1, -1, 1, 1}; /* rotations about x by 90 degrees */
  static const double low[7] = {-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973};
  static const double high[7] = {2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973};
  static const double v[7] = {2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61}, a[7] = {15, 7.5, 10, 12.5, 15, 20, 20};
  /* link, centre, radius */
  static const double sphere[12][5] = {
      {0, 0, 0, 0.05, 0.1},     {1, 0, -0.05, 0, 0.09},       {2, 0, -0.1, 0, 0.08},          {3, 0.06, 0, 0.02, 0.08},
      {4, -0.08, 0.1, 0, 0.08}, {5, 0, 0.03, -0.2, 0.07},     {5, 0, 0.06, -0.08, 0.06},      {6, 0.06, 0, 0, 0.08},
      {7, 0, 0, 0.06, 0.07},    {7, 0.04, 0.04, 0.16, 0.045}, {7, -0.04, -0.04, 0.16, 0.045}, {7, 0, 0, 0.2, 0.03}};
  memset(m, 0, sizeof *m);
  m->n = 7;
  m->period = (dbk_real)0.001;
  m->alpha = (dbk_real)3.44;
  m->alpha_self = m->alpha;
  m->alpha_joint = m->alpha;
  m->recovery = (dbk_real)0.05;
  m->sampling = (dbk_real)2e-4;
  m->rounding = (dbk_real)1e-5;
  m->lag = (dbk_real)0.02;
  m->state_age_max = (dbk_real)0.05;
  m->scene_age_max = (dbk_real)0.5;
  for (int k = 0; k < 7; ++k) {
    const dbk_real s = (dbk_real)quarter[k], c = quarter[k] ? (dbk_real)0 : (dbk_real)1;
    const dbk_real r[9] = {1, 0, 0, 0, c, -s, 0, s, c};
    memcpy(m->joint_rotation[k], r, sizeof r);
    for (int e = 0; e < 3; ++e) { m->joint_offset[k][e] = (dbk_real)offset[k][e]; }
    m->q_lower[k] = (dbk_real)low[k];
    m->q_upper[k] = (dbk_real)high[k];
    m->v_max[k] = (dbk_real)v[k];
    m->a_max[k] = (dbk_real)a[k];
    m->tracking[k] = (dbk_real)0.001;
    m->scale[k][k] = m->v_max[k];
  }
  m->tool_rotation[0] = m->tool_rotation[4] = m->tool_rotation[8] = 1;
  m->tool_offset[2] = (dbk_real)0.21;
  m->n_links = 8;
  m->n_spheres = 12;
  int at = 0;
  for (int l = 0; l < 8; ++l) {
    m->link_frame[l] = l;
    m->link_first[l] = at;
    for (; at < 12 && (int)sphere[at][0] == l; ++at) {
      m->x[at] = (dbk_real)sphere[at][1];
      m->y[at] = (dbk_real)sphere[at][2];
      m->z[at] = (dbk_real)sphere[at][3];
      m->radius[at] = (dbk_real)sphere[at][4];
    }
  }
  m->link_first[8] = 12;
  m->slide_y[9] = 1;
  m->slide_y[10] = -1;
  static const int pairs[5][2] = {{0, 5}, {0, 6}, {0, 7}, {2, 7}, {3, 7}};
  m->n_pairs = 5;
  memcpy(m->pair, pairs, sizeof pairs);
  m->n_held_links = 2;
  m->held_link[0] = 0;
  m->held_link[1] = 3;
  dbk_prepare(m);
}

/* `count` obstacles: a half-space, and random capsules and boxes, of which every third one moves */
static inline void arm_scene(dbk_scene *s, uint64_t *state, int count) {
  dbk_scene_clear(s);
  s->n_obstacles = count;
  for (int o = 0; o < count; ++o) {
    dbk_obstacle *ob = &s->obstacle[o];
    memset(ob, 0, sizeof *ob);
    ob->shape = o == 0 ? DBK_HALF_SPACE : (int32_t)(random_uniform(state) * 2);
    ob->rank = o % 3 == 2 ? DBK_RANK_BODY : DBK_RANK_OBSTACLE;
    ob->link_mask = ~0u;
    ob->flags = o % 3 == 2 ? 0 : DBK_STATIC | (o % 2 ? DBK_KNOWN : 0);
    for (int e = 0; e < 3; ++e) {
      ob->rotation[4 * e] = 1;
      ob->half[e] = random_between(state, 0.02, 0.1);
      ob->velocity[e] = ob->flags ? 0 : random_between(state, -0.3, 0.3);
    }
    if (o > 0) {
      ob->position[0] = random_between(state, -0.7, 0.7);
      ob->position[1] = random_between(state, -0.7, 0.7);
      ob->position[2] = random_between(state, 0.0, 0.9);
    }
    ob->radius = random_between(state, 0.02, 0.08);
    ob->margin = random_between(state, 0.0, 0.01);
    ob->velocity_error = ob->flags ? 0 : random_between(state, 0.0, 0.05);
  }
  dbk_scene_prepare(s);
}

#endif
