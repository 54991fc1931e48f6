/* An obstacle that moves toward the robot, and the evasion oracle; see adversarial_obstacle.h. */
#include "adversarial_obstacle.h"

#include <math.h>
#include <string.h>

#include "random.h"

#define CANDIDATES 20
#define COARSE 10 /* control periods per simulation step of the oracle */
#define PLANS 4   /* maximum number of plans drawn to obtain the required evadability */

void dbk_move_obstacle(const dbk_obstacle_rules *rules, const dbk_obstacle_plan *plan, double period,
                       dbk_true_obstacle *obstacle) {
  double change[3], length = 0.0;
  for (int32_t i = 0; i < 3; ++i) {
    change[i] = plan->target[i] - obstacle->velocity[i];
    length += change[i] * change[i];
  }
  length = sqrt(length);
  const double step = rules->acceleration * period, part = length > step ? step / length : 1.0;
  for (int32_t i = 0; i < 3; ++i) {
    obstacle->velocity[i] += part * change[i];
    obstacle->position[i] += period * obstacle->velocity[i];
  }
}

/* moves the joint velocity toward `target` within the acceleration and velocity limits, slow enough to stop before a
 * joint limit */
static void move_robot(const dbk_reference_robot *robot, const double *target, double period, double *q, double *v) {
  for (int32_t k = 0; k < robot->n; ++k) {
    const double a = robot->a_max[k], up = fmax(robot->upper[k] - q[k], 0.0), down = fmax(q[k] - robot->lower[k], 0.0);
    double w = fmin(fmax(target[k], -0.9 * sqrt(2.0 * a * down)), 0.9 * sqrt(2.0 * a * up));
    w = fmin(fmax(w, -robot->v_max[k]), robot->v_max[k]);
    v[k] = fmin(fmax(w, v[k] - a * period), v[k] + a * period);
    q[k] += period * v[k];
  }
}

/* gradient, by finite differences, of the distance between the obstacle and the closest sphere with respect to the
 * joints */
static void evasion_gradient(const dbk_reference_robot *robot, const double *q, const dbk_true_obstacle *obstacle,
                             double *gradient) {
  double centre[DBK_REFERENCE_SPHERES][3], moved[DBK_REFERENCE_SPHERES][3], least = 1e9;
  int32_t closest = 0;
  dbk_reference_centres(robot, q, centre);
  for (int32_t s = robot->first[1]; s < robot->first[robot->n_links]; ++s) {
    const double h = dbk_true_distance(obstacle, centre[s]) - robot->radius[s];
    if (h < least) {
      least = h;
      closest = s;
    }
  }
  for (int32_t k = 0; k < robot->n; ++k) {
    double other[DBK_REFERENCE_DOF];
    memcpy(other, q, sizeof(double) * (size_t)robot->n);
    other[k] += 1e-5;
    dbk_reference_centres(robot, other, moved);
    gradient[k] = (dbk_true_distance(obstacle, moved[closest]) - dbk_true_distance(obstacle, centre[closest])) / 1e-5;
  }
}

/* evasion candidates: 0 brakes, 1 to 6 follow the gradient at different speeds, and the others are random */
static void candidate(const dbk_reference_robot *robot, const double *gradient, int32_t c, uint64_t *random,
                      double *target) {
  static const double share[7] = {0.0, 0.5, 1.0, 0.25, 0.5, 0.2, 0.1};
  for (int32_t k = 0; k < robot->n; ++k) {
    if (c < 4) {
      target[k] = share[c] * robot->v_max[k] * (gradient[k] < 0.0 ? -1.0 : 1.0);
    } else if (c < 7) {
      target[k] = share[c] * robot->v_max[k] * fmin(fmax(4.0 * gradient[k], -1.0), 1.0);
    } else {
      target[k] = robot->v_max[k] * dbk_random_symmetric(random) * (c % 3 == 0 ? 1.0 : 0.4);
    }
  }
}

/* 1: every h stays as required if the robot moves to the joint velocity `target` and keeps it */
static int32_t evades(const dbk_obstacle_rules *rules, const dbk_reference_robot *robot, const double *q,
                      const double *v, const dbk_true_obstacle *obstacles, int32_t n_obstacles, int32_t moving,
                      double period, const dbk_obstacle_plan *plan, const double *target) {
  dbk_reference_state state;
  dbk_true_obstacle now[DBK_REFERENCE_OBSTACLES];
  dbk_obstacle_plan stop = *plan;
  double angles[DBK_REFERENCE_DOF], rates[DBK_REFERENCE_DOF];
  const double coarse = COARSE * period;
  const int32_t braking = (int32_t)(rules->speed / (rules->acceleration * coarse)) + 1;
  const int32_t attack = plan->periods_left / COARSE + 1;
  memset(stop.target, 0, sizeof stop.target);
  memcpy(now, obstacles, sizeof(dbk_true_obstacle) * (size_t)n_obstacles);
  memcpy(angles, q, sizeof(double) * (size_t)robot->n);
  memcpy(rates, v, sizeof(double) * (size_t)robot->n);
  dbk_reference_reset(&state);
  for (int32_t t = 0; t < attack + braking; ++t) {
    dbk_reference_distances distances;
    move_robot(robot, target, coarse, angles, rates);
    dbk_move_obstacle(rules, t < attack ? plan : &stop, coarse, &now[moving]);
    dbk_reference_measure(robot, &state, angles, now, n_obstacles, coarse, &distances);
    const double least = fmin(fmin(distances.h_static, distances.h_self), distances.h_joint);
    if (!(distances.h_moving >= rules->clearance && least >= 0.0)) { return 0; }
  }
  return 1;
}

int32_t dbk_escape_exists(const dbk_obstacle_rules *rules, const dbk_reference_robot *robot, const double *q,
                          const double *v, const dbk_true_obstacle *obstacles, int32_t n_obstacles, int32_t moving,
                          double period, const dbk_obstacle_plan *plan, uint64_t *random) {
  double gradient[DBK_REFERENCE_DOF], target[DBK_REFERENCE_DOF];
  evasion_gradient(robot, q, &obstacles[moving], gradient);
  for (int32_t c = 0; c < CANDIDATES; ++c) {
    candidate(robot, gradient, c, random, target);
    if (evades(rules, robot, q, v, obstacles, n_obstacles, moving, period, plan, target)) { return 1; }
  }
  return 0;
}

/* draws a plan toward a sphere of the robot, or in a random direction; an obstacle far from the robot always returns */
static void draw_plan(const dbk_obstacle_rules *rules, const dbk_reference_robot *robot, const double *q,
                      const dbk_true_obstacle *obstacle, double period, uint64_t *random, dbk_obstacle_plan *plan) {
  double centre[DBK_REFERENCE_SPHERES][3], direction[3] = {0, 0, 0}, length = 0.0;
  dbk_reference_centres(robot, q, centre);
  const int32_t first = robot->first[2], count = robot->first[robot->n_links] - first;
  const int32_t sphere = first + (int32_t)(dbk_random_uniform(random) * (double)count);
  for (int32_t i = 0; i < 3; ++i) {
    direction[i] = centre[sphere][i] - obstacle->position[i];
    length += direction[i] * direction[i];
  }
  length = sqrt(length);
  plan->attack = length > 0.9 || dbk_random_uniform(random) < 0.75;
  if (!plan->attack) { dbk_random_direction(random, direction); }
  const double speed = rules->speed * (dbk_random_uniform(random) < 0.7 ? 1.0 : dbk_random_uniform(random));
  const double scale = plan->attack ? fmax(length, 1e-9) : 1.0;
  for (int32_t i = 0; i < 3; ++i) { plan->target[i] = speed * direction[i] / scale; }
  const double duration =
      plan->attack ? fmin(fmax(1.2 * length / fmax(speed, 0.02), 0.2), 1.2) : 0.2 + 0.5 * dbk_random_uniform(random);
  plan->periods_left = (int32_t)(duration / period);
}

void dbk_plan_obstacle(const dbk_obstacle_rules *rules, const dbk_reference_robot *robot, const double *q,
                       const double *v, const dbk_true_obstacle *obstacles, int32_t n_obstacles, int32_t moving,
                       double period, uint64_t *random, dbk_obstacle_plan *plan) {
  for (int32_t tries = 0; tries < PLANS; ++tries) {
    draw_plan(rules, robot, q, &obstacles[moving], period, random, plan);
    plan->evadable = dbk_escape_exists(rules, robot, q, v, obstacles, n_obstacles, moving, period, plan, random);
    if (plan->evadable == rules->evadable) { return; }
  }
  if (!rules->evadable) { return; }
  /* no plan is evadable: the obstacle stops, and the oracle decides whether that is evadable */
  memset(plan->target, 0, sizeof plan->target);
  plan->periods_left = (int32_t)(0.2 / period);
  plan->attack = 0;
  plan->evadable = dbk_escape_exists(rules, robot, q, v, obstacles, n_obstacles, moving, period, plan, random);
}
