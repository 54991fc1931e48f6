// Stub: an error goes to stderr.
#ifndef STUB_RCLCPP_LOGGING_HPP_
#define STUB_RCLCPP_LOGGING_HPP_

#include <cstdio>

#define RCLCPP_ERROR(logger, ...) ((void)(logger), std::fprintf(stderr, __VA_ARGS__), std::fprintf(stderr, "\n"))

#endif
