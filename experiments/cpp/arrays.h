// Arrays of an exported folder, and the program around both examples.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <iostream>
#include <iterator>
#include <stdexcept>
#include <string>
#include <vector>

// Values of an array in NumPy's .npy format: 8 bytes of magic, 2 bytes of header length, the header, the values.
inline std::vector<char> read_array(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  std::vector<char> bytes{std::istreambuf_iterator<char>(file), {}};
  if (bytes.size() < 10 || std::memcmp(bytes.data(), "\x93NUMPY\x01", 7) != 0)
    throw std::runtime_error(path + ": expected an array in NumPy's format 1.0");
  const auto length = static_cast<unsigned char>(bytes[8]) + 256u * static_cast<unsigned char>(bytes[9]);
  if (bytes.size() < 10 + length) throw std::runtime_error(path + ": expected a whole file");
  return {bytes.begin() + 10 + length, bytes.end()};
}

// Largest difference, relative to values above 1; two NaN are equal.
inline float largest_difference(const float* values, const std::vector<float>& expected) {
  float largest = 0;
  for (size_t i = 0; i < expected.size(); ++i) {
    if (std::isnan(values[i]) && std::isnan(expected[i])) continue;
    const float difference = std::abs(values[i] - expected[i]) / std::max(std::abs(expected[i]), 1.0f);
    largest = std::isnan(difference) ? INFINITY : std::max(largest, difference);
  }
  return largest;
}

// Print the first values of an output, and return its largest difference from the array in the folder.
inline float compare(const std::string& folder, const std::string& name, const float* values, size_t count) {
  const auto bytes = read_array(folder + "/check/" + name + ".npy");
  std::vector<float> expected(bytes.size() / sizeof(float));
  std::memcpy(expected.data(), bytes.data(), expected.size() * sizeof(float));
  if (count != expected.size()) throw std::runtime_error(name + ": expected as many numbers as in the folder");
  std::cout << name << ":";
  for (size_t k = 0; k < std::min<size_t>(count, 10); ++k) std::cout << " " << values[k];
  std::cout << "\n";
  return largest_difference(values, expected);
}

// Call `run(folder)`, which returns the largest difference of all outputs: PROGRAM FOLDER [TOLERANCE].
template <typename Run>
int run_example(int argc, char** argv, Run run) {
  if (argc < 2) {
    std::cerr << "usage: " << argv[0] << " FOLDER [TOLERANCE]\n";
    return 2;
  }
  try {
    if (!std::ifstream(std::string(argv[1]) + "/program.onnx"))
      throw std::runtime_error(std::string(argv[1]) + ": expected program.onnx, got none; pip install 'mfvpr[export]', "
                                                      "and export again");
    const float tolerance = argc > 2 ? std::strtof(argv[2], nullptr) : 1e-4f;
    const float largest = run(std::string(argv[1]));
    std::cout << "largest difference: " << largest << " (tolerance " << tolerance << ")\n";
    return largest <= tolerance ? 0 : 1;
  } catch (const std::exception& error) {
    std::cerr << error.what() << "\n";
    return 2;
  }
}
