#include "dbk_mover.h"

#include <math.h>
#include <string.h>

#include "dbk_chance.h"

#define CANDIDATES 20
#define COARSE 10 /* periods of one step of the oracle */
#define PLANS 4   /* plans tried before the mover gives up the one it wants */

void dbk_mover_step(const dbk_mover_rules *rules, const dbk_plan *plan, double period, dbk_thing *thing) {
  double change[3], size = 0.0;
  for (int32_t i = 0; i < 3; ++i) {
    change[i] = plan->target[i] - thing->velocity[i];
    size += change[i] * change[i];
  }
  size = sqrt(size);
  const double most = rules->acceleration * period, part = size > most ? most / size : 1.0;
  for (int32_t i = 0; i < 3; ++i) {
    thing->velocity[i] += part * change[i];
    thing->position[i] += period * thing->velocity[i];
  }
}

/* joint velocity goes toward `wish` within acceleration and velocity limits, slow enough to stop before a joint limit */
static void drive(const dbk_judge_body *body, const double *wish, double period, double *q, double *v) {
  for (int32_t k = 0; k < body->n; ++k) {
    const double a = body->a_max[k], up = fmax(body->upper[k] - q[k], 0.0), down = fmax(q[k] - body->lower[k], 0.0);
    double w = fmin(fmax(wish[k], -0.9 * sqrt(2.0 * a * down)), 0.9 * sqrt(2.0 * a * up));
    w = fmin(fmax(w, -body->v_max[k]), body->v_max[k]);
    v[k] = fmin(fmax(w, v[k] - a * period), v[k] + a * period);
    q[k] += period * v[k];
  }
}

/* joint rates that increase the gap between the mover and the sphere nearest to it, by differences */
static void flee(const dbk_judge_body *body, const double *q, const dbk_thing *mover, double *gradient) {
  double at[DBK_JUDGE_SPHERES][3], moved[DBK_JUDGE_SPHERES][3], best = 1e9;
  int32_t nearest = 0;
  dbk_judge_centres(body, q, at);
  for (int32_t s = body->first[1]; s < body->first[body->n_links]; ++s) {
    const double h = dbk_thing_distance(mover, at[s]) - body->radius[s];
    if (h < best) {
      best = h;
      nearest = s;
    }
  }
  for (int32_t k = 0; k < body->n; ++k) {
    double other[DBK_JUDGE_DOF];
    memcpy(other, q, sizeof(double) * (size_t)body->n);
    other[k] += 1e-5;
    dbk_judge_centres(body, other, moved);
    gradient[k] = (dbk_thing_distance(mover, moved[nearest]) - dbk_thing_distance(mover, at[nearest])) / 1e-5;
  }
}

/* candidate 0 brakes; the next go down the gradient, faster and slower; the rest are drawn at random */
static void candidate(const dbk_judge_body *body, const double *gradient, int32_t c, uint64_t *chance, double *wish) {
  static const double share[7] = {0.0, 0.5, 1.0, 0.25, 0.5, 0.2, 0.1};
  for (int32_t k = 0; k < body->n; ++k) {
    if (c < 4) {
      wish[k] = share[c] * body->v_max[k] * (gradient[k] < 0.0 ? -1.0 : 1.0);
    } else if (c < 7) {
      wish[k] = share[c] * body->v_max[k] * fmin(fmax(4.0 * gradient[k], -1.0), 1.0);
    } else {
      wish[k] = body->v_max[k] * dbk_either(chance) * (c % 3 == 0 ? 1.0 : 0.4);
    }
  }
}

/* the control that goes to `wish` and stays there keeps every h at `spare` */
static int32_t survives(const dbk_mover_rules *rules, const dbk_judge_body *body, const double *q, const double *v,
                        const dbk_thing *things, int32_t n_things, int32_t at, double period, const dbk_plan *plan,
                        const double *wish) {
  dbk_judge judge;
  dbk_thing now[DBK_JUDGE_THINGS];
  dbk_plan stop = *plan;
  double angles[DBK_JUDGE_DOF], rates[DBK_JUDGE_DOF];
  const double coarse = COARSE * period;
  const int32_t braking = (int32_t)(rules->speed / (rules->acceleration * coarse)) + 1;
  const int32_t attack = plan->left / COARSE + 1;
  memset(stop.target, 0, sizeof stop.target);
  memcpy(now, things, sizeof(dbk_thing) * (size_t)n_things);
  memcpy(angles, q, sizeof(double) * (size_t)body->n);
  memcpy(rates, v, sizeof(double) * (size_t)body->n);
  dbk_judge_reset(&judge);
  for (int32_t t = 0; t < attack + braking; ++t) {
    dbk_verdict verdict;
    drive(body, wish, coarse, angles, rates);
    dbk_mover_step(rules, t < attack ? plan : &stop, coarse, &now[at]);
    dbk_judge_look(body, &judge, angles, now, n_things, coarse, &verdict);
    const double least = fmin(fmin(verdict.still, verdict.self), verdict.joint);
    if (!(verdict.moving >= rules->spare && least >= 0.0)) { return 0; }
  }
  return 1;
}

int32_t dbk_escape_exists(const dbk_mover_rules *rules, const dbk_judge_body *body, const double *q, const double *v,
                          const dbk_thing *things, int32_t n_things, int32_t at, double period, const dbk_plan *plan,
                          uint64_t *chance) {
  double gradient[DBK_JUDGE_DOF], wish[DBK_JUDGE_DOF];
  flee(body, q, &things[at], gradient);
  for (int32_t c = 0; c < CANDIDATES; ++c) {
    candidate(body, gradient, c, chance, wish);
    if (survives(rules, body, q, v, things, n_things, at, period, plan, wish)) { return 1; }
  }
  return 0;
}

/* at a sphere of the robot, or anywhere; back toward the middle when far out */
static void draw(const dbk_mover_rules *rules, const dbk_judge_body *body, const double *q, const dbk_thing *thing,
                 double period, uint64_t *chance, dbk_plan *plan) {
  double at[DBK_JUDGE_SPHERES][3], way[3] = {0, 0, 0}, length = 0.0;
  dbk_judge_centres(body, q, at);
  const int32_t first = body->first[2], count = body->first[body->n_links] - first;
  const int32_t aim = first + (int32_t)(dbk_chance(chance) * (double)count);
  for (int32_t i = 0; i < 3; ++i) {
    way[i] = at[aim][i] - thing->position[i];
    length += way[i] * way[i];
  }
  length = sqrt(length);
  plan->attack = length > 0.9 || dbk_chance(chance) < 0.75;
  if (!plan->attack) { dbk_direction(chance, way); }
  const double pace = rules->speed * (dbk_chance(chance) < 0.7 ? 1.0 : dbk_chance(chance));
  const double size = plan->attack ? fmax(length, 1e-9) : 1.0;
  for (int32_t i = 0; i < 3; ++i) { plan->target[i] = pace * way[i] / size; }
  const double until = plan->attack ? fmin(fmax(1.2 * length / fmax(pace, 0.02), 0.2), 1.2) : 0.2 + 0.5 * dbk_chance(chance);
  plan->left = (int32_t)(until / period);
}

void dbk_mover_plan(const dbk_mover_rules *rules, const dbk_judge_body *body, const double *q, const double *v,
                    const dbk_thing *things, int32_t n_things, int32_t at, double period, uint64_t *chance,
                    dbk_plan *plan) {
  for (int32_t tries = 0; tries < PLANS; ++tries) {
    draw(rules, body, q, &things[at], period, chance, plan);
    plan->evadable = dbk_escape_exists(rules, body, q, v, things, n_things, at, period, plan, chance);
    if (plan->evadable == rules->evadable) { return; }
  }
  if (!rules->evadable) { return; }
  /* nothing that the robot could evade: come to rest; whether that was evadable is said as well */
  memset(plan->target, 0, sizeof plan->target);
  plan->left = (int32_t)(0.2 / period);
  plan->attack = 0;
  plan->evadable = dbk_escape_exists(rules, body, q, v, things, n_things, at, period, plan, chance);
}
