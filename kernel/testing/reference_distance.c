/* Reference kinematics and distances in float64; see reference_distance.h. */
#include "reference_distance.h"

#include <math.h>

#define MAX_DISTANCE 1e3

static double norm3(const double a[3]) { return sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2]); }

static double distance3(const double a[3], const double b[3]) {
  const double d[3] = {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
  return norm3(d);
}

void dbk_reference_centres(const dbk_reference_robot *robot, const double *q, double centre[DBK_REFERENCE_SPHERES][3]) {
  double R[DBK_REFERENCE_DOF + 1][3][3] = {{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}},
                               p[DBK_REFERENCE_DOF + 1][3] = {{0, 0, 0}};
  /* frames of the chain; all joints are revolute */
  for (int32_t k = 0; k < robot->n; ++k) {
    const double c = cos(q[k]), s = sin(q[k]), *F = robot->rotation[k];
    double rotated[3][3]; /* the fixed rotation times the rotation about local z */
    for (int32_t i = 0; i < 3; ++i) {
      rotated[i][0] = F[3 * i] * c + F[3 * i + 1] * s;
      rotated[i][1] = -F[3 * i] * s + F[3 * i + 1] * c;
      rotated[i][2] = F[3 * i + 2];
    }
    for (int32_t i = 0; i < 3; ++i) {
      p[k + 1][i] = p[k][i];
      for (int32_t j = 0; j < 3; ++j) {
        p[k + 1][i] += R[k][i][j] * robot->offset[k][j];
        R[k + 1][i][j] = R[k][i][0] * rotated[0][j] + R[k][i][1] * rotated[1][j] + R[k][i][2] * rotated[2][j];
      }
    }
  }
  /* sphere centres */
  for (int32_t l = 0; l < robot->n_links; ++l) {
    const int32_t f = robot->frame[l];
    for (int32_t s = robot->first[l]; s < robot->first[l + 1]; ++s) {
      const double *local = robot->centre[s];
      for (int32_t i = 0; i < 3; ++i) {
        centre[s][i] = p[f][i] + (R[f][i][0] * local[0] + R[f][i][1] * local[1] + R[f][i][2] * local[2]);
      }
    }
  }
}

double dbk_true_distance(const dbk_true_obstacle *obstacle, const double point[3]) {
  double local[3] = {0, 0, 0}, outside[3], deepest = -MAX_DISTANCE;
  for (int32_t i = 0; i < 3; ++i) {
    for (int32_t j = 0; j < 3; ++j) { local[i] += obstacle->rotation[3 * j + i] * (point[j] - obstacle->position[j]); }
  }
  if (obstacle->shape == DBK_TRUE_HALF_SPACE) { return local[2]; }
  if (obstacle->shape == DBK_TRUE_CAPSULE) {
    const double beyond = fmax(fabs(local[2]) - obstacle->half[2], 0.0);
    return sqrt(local[0] * local[0] + local[1] * local[1] + beyond * beyond) - obstacle->radius;
  }
  /* a box: the distance outside, or minus the distance to the nearest face inside */
  for (int32_t i = 0; i < 3; ++i) {
    const double excess = fabs(local[i]) - obstacle->half[i];
    outside[i] = fmax(excess, 0.0);
    deepest = fmax(deepest, excess);
  }
  return norm3(outside) + fmin(deepest, 0.0);
}

/* speed of sphere s toward the obstacle between the last two measurements: the displacement along the inward normal,
 * which is computed by central differences */
static double approach_of(const dbk_reference_state *state, const dbk_true_obstacle *obstacle, int32_t s,
                          double period) {
  const double step = 1e-6;
  double gradient[3], along = 0.0;
  for (int32_t i = 0; i < 3; ++i) {
    double plus[3] = {state->centre[s][0], state->centre[s][1], state->centre[s][2]};
    double minus[3] = {plus[0], plus[1], plus[2]};
    plus[i] += step;
    minus[i] -= step;
    gradient[i] = dbk_true_distance(obstacle, plus) - dbk_true_distance(obstacle, minus);
  }
  const double length = fmax(norm3(gradient), 1e-12);
  for (int32_t i = 0; i < 3; ++i) { along -= gradient[i] / length * (state->centre[s][i] - state->previous[s][i]); }
  return along / period;
}

/* smallest h between a link and an obstacle; updates the approach speed */
static double link_distance(const dbk_reference_robot *robot, const dbk_reference_state *state,
                            const dbk_true_obstacle *obstacle, int32_t link, double period, double *approach) {
  double least = MAX_DISTANCE;
  for (int32_t s = robot->first[link]; s < robot->first[link + 1]; ++s) {
    const double h = dbk_true_distance(obstacle, state->centre[s]) - robot->radius[s];
    least = fmin(least, h);
    if (h < 0.0 && obstacle->moving) { *approach = fmax(*approach, approach_of(state, obstacle, s, period)); }
  }
  return least;
}

/* smallest h between two links */
static double pair_distance(const dbk_reference_robot *robot, const dbk_reference_state *state, int32_t a, int32_t b) {
  double least = MAX_DISTANCE;
  for (int32_t i = robot->first[a]; i < robot->first[a + 1]; ++i) {
    for (int32_t j = robot->first[b]; j < robot->first[b + 1]; ++j) {
      least = fmin(least, distance3(state->centre[i], state->centre[j]) - robot->radius[i] - robot->radius[j]);
    }
  }
  return least;
}

void dbk_reference_reset(dbk_reference_state *state) { state->fresh = 1; }

/* moves the spheres to posture q; `moved` is the maximum displacement per link since the last measurement */
static void move_spheres(const dbk_reference_robot *robot, dbk_reference_state *state, const double *q,
                         double moved[DBK_REFERENCE_LINKS]) {
  double next[DBK_REFERENCE_SPHERES][3];
  dbk_reference_centres(robot, q, next);
  for (int32_t l = 0; l < robot->n_links; ++l) {
    moved[l] = 0.0;
    for (int32_t s = robot->first[l]; s < robot->first[l + 1]; ++s) {
      if (!state->fresh) { moved[l] = fmax(moved[l], distance3(next[s], state->centre[s])); }
      for (int32_t i = 0; i < 3; ++i) {
        state->previous[s][i] = state->fresh ? next[s][i] : state->centre[s][i];
        state->centre[s][i] = next[s][i];
      }
    }
  }
}

void dbk_reference_measure(const dbk_reference_robot *robot, dbk_reference_state *state, const double *q,
                           const dbk_true_obstacle *obstacles, int32_t n_obstacles, double period,
                           dbk_reference_distances *distances) {
  double moved[DBK_REFERENCE_LINKS];
  const double cap = state->fresh ? MAX_DISTANCE : DBK_REFERENCE_EXACT;
  const dbk_reference_distances saturated = {cap, cap, cap, MAX_DISTANCE, -MAX_DISTANCE};
  *distances = saturated;
  move_spheres(robot, state, q, moved);
  /* links against obstacles */
  for (int32_t o = 0; o < n_obstacles; ++o) {
    const double shift = state->fresh ? 0.0 : distance3(obstacles[o].position, state->obstacle[o]);
    double *least = obstacles[o].moving ? &distances->h_moving : &distances->h_static;
    for (int32_t i = 0; i < 3; ++i) { state->obstacle[o][i] = obstacles[o].position[i]; }
    for (int32_t l = 0; l < robot->n_links; ++l) {
      if (robot->frame[l] == 0) { continue; } /* the base does not move */
      double *bound = &state->bound[l][o];
      *bound -= moved[l] + shift;
      if (!state->fresh && *bound > DBK_REFERENCE_EXACT) { continue; }
      *bound = link_distance(robot, state, &obstacles[o], l, period, &distances->approach);
      *least = fmin(*least, *bound);
    }
  }
  /* links against links */
  for (int32_t p = 0; p < robot->n_pairs; ++p) {
    const int32_t a = robot->pair[p][0], b = robot->pair[p][1];
    state->self_bound[p] -= moved[a] + moved[b];
    if (!state->fresh && state->self_bound[p] > DBK_REFERENCE_EXACT) { continue; }
    state->self_bound[p] = pair_distance(robot, state, a, b);
    distances->h_self = fmin(distances->h_self, state->self_bound[p]);
  }
  /* joint limits */
  for (int32_t k = 0; k < robot->n; ++k) {
    distances->h_joint = fmin(distances->h_joint, fmin(q[k] - robot->lower[k], robot->upper[k] - q[k]));
  }
  state->fresh = 0;
}
