/* A closed loop in which every error takes the worst value within its stated bound; see worst_case_loop.h. */
#include "worst_case_loop.h"

#include <math.h>

#include <string.h>

#include "random.h"

#define CLEAR 1e-2    /* [m] above this h, earlier failed premises no longer explain a violation */
#define APPROACH 1e-3 /* [m/s] above this speed of the robot, a contact counts as the robot's violation */

typedef struct {
  uint64_t random;
  double q[DBK_MAX_DOF], v[DBK_MAX_DOF], u[DBK_MAX_DOF];
  double sign[DBK_MAX_DOF];                        /* direction of each joint that opens the closest row */
  double worst_noise;                              /* 1: errors are worst-case, 0: random */
  double measured[DBK_MAX_DOF], sent[DBK_MAX_DOF]; /* last measured state; dt sum u since then */
  double rate[DBK_MAX_DOF], bias[DBK_REFERENCE_OBSTACLES][3];
  int32_t state_age, burst, scene_step, jitter, failed_premises, in_contact;
  dbk_obstacle_plan plan;
} loop_state;

static int32_t closest_row(const dbk_ctx *ctx) {
  int32_t row = -1;
  for (int32_t r = 0; r < ctx->rows.count; ++r) {
    if (row < 0 || ctx->rows.h[r] < ctx->rows.h[row]) { row = r; }
  }
  return row;
}

/* chooses the nominal control (full speed against the gradient of a row, or bang-bang) and the kind of noise */
static void choose(const dbk_model *model, const dbk_ctx *ctx, const dbk_loop_config *config, loop_state *s,
                   dbk_in *in) {
  int32_t row = closest_row(ctx);
  if (ctx->rows.count > 0 && dbk_random_uniform(&s->random) < 0.3) {
    row = (int32_t)(dbk_random_uniform(&s->random) * (double)ctx->rows.count);
  }
  const int32_t toward = row >= 0 && dbk_random_uniform(&s->random) < config->toward;
  for (int32_t k = 0; k < model->n; ++k) {
    double sign = dbk_random_uniform(&s->random) < 0.5 ? -1.0 : 1.0;
    if (toward) { sign = ctx->rows.a[k][row] > (dbk_real)0 ? -1.0 : 1.0; }
    in->u_nom[k] = (dbk_real)sign * model->v_max[k];
  }
  s->worst_noise = dbk_random_uniform(&s->random) < 0.5 ? 1.0 : 0.0;
  s->jitter = dbk_random_uniform(&s->random) < 0.5;
}

/* the direction of each joint that opens the closest row; without a row it is random and changes rarely */
static void find_signs(const dbk_model *model, const dbk_ctx *ctx, loop_state *s) {
  const int32_t row = closest_row(ctx);
  for (int32_t k = 0; k < model->n; ++k) {
    if (row >= 0) {
      s->sign[k] = ctx->rows.a[k][row] > (dbk_real)0 ? 1.0 : -1.0;
    } else if (dbk_random_uniform(&s->random) < 0.01) {
      s->sign[k] = dbk_random_uniform(&s->random) < 0.5 ? -1.0 : 1.0;
    }
  }
}

/* the worst direction of a position error: away from the closest sphere of the robot */
static void worst_direction(const dbk_reference_robot *robot, const double centre[DBK_REFERENCE_SPHERES][3],
                            const dbk_true_obstacle *obstacle, double direction[3]) {
  int32_t closest = robot->first[1];
  double least = 1e9, length = 0.0;
  for (int32_t i = robot->first[1]; i < robot->first[robot->n_links]; ++i) {
    const double h = dbk_true_distance(obstacle, centre[i]) - robot->radius[i];
    if (h < least) {
      least = h;
      closest = i;
    }
  }
  for (int32_t i = 0; i < 3; ++i) {
    double other[3] = {centre[closest][0], centre[closest][1], centre[closest][2]};
    other[i] += 1e-6;
    direction[i] = dbk_true_distance(obstacle, centre[closest]) - dbk_true_distance(obstacle, other);
    length += direction[i] * direction[i];
  }
  for (int32_t i = 0; i < 3; ++i) { direction[i] /= fmax(sqrt(length), 1e-12); }
}

/* perception: a new scene with errors at their bounds, unless no frame is due or the frame is lost */
static void observe_scene(const dbk_loop_config *config, const dbk_reference_robot *robot,
                          const dbk_reference_state *reference, const dbk_true_obstacle *obstacles, int32_t n_obstacles,
                          int32_t t, loop_state *s, dbk_scene *scene) {
  if (t > 0 && (t % config->frame != 0 || (t - s->scene_step + config->frame <= config->scene_longest &&
                                           dbk_random_uniform(&s->random) < config->scene_drop))) {
    return;
  }
  for (int32_t o = 0; o < n_obstacles; ++o) {
    double error[3] = {0, 0, 0};
    if (t == 0 || s->jitter) { dbk_random_direction(&s->random, s->bias[o]); }
    if (obstacles[o].moving) { dbk_random_direction(&s->random, error); }
    if (s->worst_noise > 0.5) {
      worst_direction(robot, reference->centre, &obstacles[o], s->bias[o]);
      if (obstacles[o].moving) { memcpy(error, s->bias[o], sizeof error); }
    }
    for (int32_t i = 0; i < 3; ++i) {
      scene->obstacle[o].position[i] = (dbk_real)(obstacles[o].position[i] + config->place_noise * s->bias[o][i]);
      scene->obstacle[o].velocity[i] =
          (dbk_real)(config->velocity_share * (obstacles[o].velocity[i] + config->speed_noise * error[i]));
    }
  }
  s->scene_step = t;
  dbk_scene_prepare(scene);
}

/* joint measurement: a new state with errors at their bounds, or the last one if states are lost, with dead
 * reckoning */
static void measure_state(const dbk_model *model, const dbk_loop_config *config, loop_state *s, dbk_in *in) {
  if (s->burst > 0) {
    --s->burst;
    ++s->state_age;
  } else {
    s->state_age = 0;
    for (int32_t k = 0; k < model->n; ++k) {
      const double a = s->worst_noise > 0.5 ? s->sign[k] : dbk_random_symmetric(&s->random);
      const double b = s->worst_noise > 0.5 ? s->sign[k] : dbk_random_symmetric(&s->random);
      s->measured[k] = s->q[k] + config->q_noise * a;
      s->rate[k] = s->v[k] + config->v_noise * b;
      s->sent[k] = 0.0;
    }
    if (config->state_longest > 0 && dbk_random_uniform(&s->random) < config->state_drop) {
      s->burst = 1 + (int32_t)(dbk_random_uniform(&s->random) * (double)config->state_longest);
    }
  }
  for (int32_t k = 0; k < model->n; ++k) {
    in->q[k] = (dbk_real)(s->measured[k] + (config->dead_reckoning ? s->sent[k] : 0.0));
    in->v[k] = (dbk_real)s->rate[k];
  }
  in->state_age = (dbk_real)((double)s->state_age * (double)model->period);
}

/* the plant over one period: ydot = u + r, and q follows y with an exact first-order lag */
static void integrate(const dbk_model *model, const dbk_loop_config *config, loop_state *s) {
  const double dt = (double)model->period;
  for (int32_t k = 0; k < model->n; ++k) {
    const double u = s->u[k] - config->push * s->sign[k];
    if (config->lag > 0.0) {
      const double decay = exp(-dt / config->lag);
      s->q[k] += u * dt + (s->v[k] - u) * config->lag * (1.0 - decay);
      s->v[k] = u + (s->v[k] - u) * decay;
    } else {
      s->q[k] += u * dt;
      s->v[k] = u;
    }
    s->sent[k] += dt * s->u[k];
  }
}

/* one call of the filter, unless the step is late; returns the failed premises as bits */
static int32_t control(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_loop_config *config,
                       dbk_in *in, loop_state *s, dbk_loop_result *result) {
  dbk_out out;
  int32_t failed = s->state_age > 0 ? DBK_NOT_FRESH : 0;
  if (dbk_random_uniform(&s->random) < config->late) { return failed | DBK_NOT_ON_TIME; }
  const dbk_status status = dbk_step(model, scene, ctx, in, &out);
  ++result->status[status];
  result->rows += out.n_rows;
  result->iterations += out.iterations;
  if (out.iterations > result->max_iterations) { result->max_iterations = out.iterations; }
  if (out.n_rows > result->max_rows) { result->max_rows = out.n_rows; }
  for (int32_t k = 0; k < model->n; ++k) {
    const double change = fabs((double)out.u[k] - s->u[k]);
    result->bound_violation += change > (double)model->a_max[k] * (double)model->period * (1.0 + 1e-5) + 1e-6;
    s->u[k] = (double)out.u[k];
  }
  if (out.flags & (DBK_STALE_STATE | DBK_STALE_SCENE)) { failed |= DBK_NOT_FRESH; }
  if (out.flags & (DBK_INFEASIBLE | DBK_UNAVOIDABLE | DBK_NO_GRADIENT)) { failed |= DBK_NOT_FEASIBLE; }
  return failed | (out.certified ? 0 : DBK_NOT_CERTIFIED);
}

/* counts for the moving obstacle */
static void count_moving(const dbk_reference_distances *distances, loop_state *s, dbk_loop_result *result) {
  const int32_t class = s->plan.evadable != 0;
  ++result->plan_steps[class];
  result->h_moving[class] = fmin(result->h_moving[class], distances->h_moving);
  const int32_t contact = distances->h_moving < 0.0, approaching = contact && distances->approach > APPROACH;
  result->contact[class] += contact;
  result->moving_violation[class][s->failed_premises] += approaching;
  if (contact) { result->approach[class] = fmax(result->approach[class], distances->approach); }
  if (contact && !s->in_contact) {
    ++result->contact_onset[class];
    result->approaching_onset[class] += approaching;
  }
  s->in_contact = contact;
}

/* counts of one step; failed premises accumulate until h is clearly positive again */
static void count(const dbk_reference_distances *distances, int32_t t, int32_t failed, int32_t moving, loop_state *s,
                  dbk_loop_result *result) {
  const double least = fmin(distances->h_static, fmin(distances->h_self, distances->h_joint));
  ++result->steps;
  for (int32_t p = 0; p < 4; ++p) { result->premise_held[p] += !(failed & (1 << p)); }
  result->premise_held[4] += failed == 0;
  s->failed_premises = (fmin(least, distances->h_moving) > CLEAR ? 0 : s->failed_premises) | failed;
  result->static_violation[s->failed_premises] += least < 0.0;
  if (distances->h_static < result->h_static) {
    result->h_static = distances->h_static;
    result->worst_step = t;
  }
  result->h_self = fmin(result->h_self, distances->h_self);
  result->h_joint = fmin(result->h_joint, distances->h_joint);
  if (moving >= 0) { count_moving(distances, s, result); }
}

/* a moving obstacle that touches the robot stops and withdraws: a further push into the robot is outside the model */
static void withdraw(const dbk_reference_robot *robot, const dbk_reference_state *reference,
                     const dbk_loop_config *config, double period, loop_state *s, dbk_true_obstacle *obstacle) {
  double direction[3];
  worst_direction(robot, reference->centre, obstacle, direction);
  for (int32_t i = 0; i < 3; ++i) {
    obstacle->velocity[i] = 0.0;
    s->plan.target[i] = config->obstacle.speed * direction[i];
  }
  s->plan.periods_left = (int32_t)(0.5 / period);
  s->plan.attack = 0;
}

/* index of the first moving obstacle, or -1 */
static int32_t first_moving(const dbk_true_obstacle *obstacles, int32_t n_obstacles) {
  for (int32_t o = 0; o < n_obstacles; ++o) {
    if (obstacles[o].moving) { return o; }
  }
  return -1;
}

void dbk_run_worst_case_loop(const dbk_model *model, dbk_scene *scene, dbk_ctx *ctx, const dbk_reference_robot *robot,
                             dbk_true_obstacle *obstacles, int32_t n_obstacles, const dbk_loop_config *config,
                             double *q, double *q_log, dbk_loop_result *result) {
  static const dbk_loop_result empty = {
      .h_static = 1e3, .h_self = 1e3, .h_joint = 1e3, .h_moving = {1e3, 1e3}, .approach = {-1e3, -1e3}};
  const int32_t n = model->n, moving = first_moving(obstacles, n_obstacles);
  const double period = (double)model->period;
  dbk_in in;
  loop_state s = {.random = config->seed};
  dbk_reference_state reference;
  dbk_reference_distances distances;
  *result = empty;
  memset(&in, 0, sizeof in);
  ctx->rows.count = 0;
  memcpy(s.q, q, sizeof(double) * (size_t)n);
  dbk_reference_reset(&reference);
  dbk_reference_measure(robot, &reference, s.q, obstacles, n_obstacles, period, &distances);
  for (int32_t t = 0; t < config->steps; ++t) {
    /* the obstacle's plan, observation and nominal control */
    if (moving >= 0 && s.plan.periods_left-- <= 0) {
      dbk_plan_obstacle(&config->obstacle, robot, s.q, s.v, obstacles, n_obstacles, moving, period, &s.random, &s.plan);
      ++result->plans[s.plan.evadable != 0];
    }
    find_signs(model, ctx, &s);
    observe_scene(config, robot, &reference, obstacles, n_obstacles, t, &s, scene);
    measure_state(model, config, &s, &in);
    if (t % config->hold == 0) { choose(model, ctx, config, &s, &in); }
    in.scene_age = (dbk_real)((double)(t - s.scene_step) * period);
    /* the filter, the plant and the obstacle */
    const int32_t failed = control(model, scene, ctx, config, &in, &s, result);
    integrate(model, config, &s);
    if (moving >= 0) { dbk_move_obstacle(&config->obstacle, &s.plan, period, &obstacles[moving]); }
    /* the true distances */
    dbk_reference_measure(robot, &reference, s.q, obstacles, n_obstacles, period, &distances);
    const int32_t before = s.in_contact;
    count(&distances, t, failed, moving, &s, result);
    if (s.in_contact && !before) { withdraw(robot, &reference, config, period, &s, &obstacles[moving]); }
    if (q_log) { memcpy(q_log + (int64_t)t * n, s.q, sizeof(double) * (size_t)n); }
  }
  memcpy(q, s.q, sizeof(double) * (size_t)n);
}
