// Arrays of an exported folder, and the program around both examples.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <functional>
#include <iostream>
#include <iterator>
#include <map>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

using Bytes = std::vector<char>;
using Inputs = std::function<Bytes(const std::string&)>;            // an array by its name
using Outputs = std::vector<std::pair<std::string, Bytes>>;         // in the order of the program
using Run = Outputs (*)(const std::string& folder, const Inputs&);  // a program of a folder in one of the runtimes

// Values of an array in NumPy's .npy format: 8 bytes of magic, 2 bytes of header length, the header, the values.
inline Bytes read_array(const std::string& path, std::string* header = nullptr) {
  std::ifstream file(path, std::ios::binary);
  Bytes bytes{std::istreambuf_iterator<char>(file), {}};
  if (bytes.size() < 10 || std::memcmp(bytes.data(), "\x93NUMPY\x01", 7) != 0)
    throw std::runtime_error(path + ": expected an array in NumPy's format 1.0");
  const auto length = static_cast<unsigned char>(bytes[8]) + 256u * static_cast<unsigned char>(bytes[9]);
  if (bytes.size() < 10 + length) throw std::runtime_error(path + ": expected a whole file");
  if (header) header->assign(bytes.begin() + 10, bytes.begin() + 10 + length);
  return {bytes.begin() + 10 + length, bytes.end()};
}

// Values of an array as numbers: a byte each of a mask, otherwise float32.
inline std::vector<float> numbers(const std::string& name, const Bytes& bytes) {
  if (name == "mask") return {bytes.begin(), bytes.end()};
  std::vector<float> values(bytes.size() / sizeof(float));
  std::memcpy(values.data(), bytes.data(), values.size() * sizeof(float));
  return values;
}

// Largest difference, relative to values above 1; two NaN are equal.
inline float largest_difference(const std::vector<float>& values, const std::vector<float>& expected) {
  float largest = 0;
  for (size_t i = 0; i < expected.size(); ++i) {
    if (std::isnan(values[i]) && std::isnan(expected[i])) continue;
    const float difference = std::abs(values[i] - expected[i]) / std::max(std::abs(expected[i]), 1.0f);
    largest = std::isnan(difference) ? INFINITY : std::max(largest, difference);
  }
  return largest;
}

// Print the first values of an output, and return its largest difference from the array in the folder.
inline float compare(const std::string& folder, const std::string& name, const Bytes& bytes) {
  const auto values = numbers(name, bytes), expected = numbers(name, read_array(folder + "/check/" + name + ".npy"));
  if (values.size() != expected.size()) throw std::runtime_error(name + ": expected as many numbers as in the folder");
  std::cout << name << ":";
  for (size_t k = 0; k < std::min<size_t>(values.size(), 10); ++k) std::cout << " " << values[k];
  std::cout << "\n";
  return largest_difference(values, expected);
}

// Features of an image in the format PPM (P6, without comments): outputs of the extraction, and the image size.
inline std::map<std::string, Bytes> extract(const std::string& folder, const std::string& path, Run run) {
  std::ifstream file(path, std::ios::binary);
  std::string format, header;
  size_t width = 0, height = 0, largest = 0;
  if (!(file >> format >> width >> height >> largest) || format != "P6" || largest != 255)
    throw std::runtime_error(path + ": expected an RGB image of 8 bits in the format PPM, P6");
  Bytes image = read_array(folder + "/check/image.npy", &header);
  if (header.find("(" + std::to_string(height) + ", " + std::to_string(width) + ", 3)") == std::string::npos)
    throw std::runtime_error(path + ": expected an image of the size in " + folder + "/export.json; resize it");
  file.get();
  if (!file.read(image.data(), image.size())) throw std::runtime_error(path + ": expected a whole file");
  const auto outputs = run(folder, [&](const std::string&) { return image; });
  std::map<std::string, Bytes> features(outputs.begin(), outputs.end());
  const float size[] = {static_cast<float>(width), static_cast<float>(height)};
  features["image_size"].resize(sizeof(size));
  std::memcpy(features["image_size"].data(), size, sizeof(size));
  const auto& mask = features["mask"];
  std::cout << path << ": " << std::count(mask.begin(), mask.end(), 1) << " keypoints\n";
  return features;
}

// Print the scores of an image and its only candidate. Candidates that the exported system has room for stay empty.
inline void score_images(char** paths, Run run) {
  const std::string system = paths[1];
  const std::map<std::string, Bytes> features[] = {extract(paths[0], paths[2], run), extract(paths[0], paths[3], run)};
  const auto outputs = run(system, [&](const std::string& name) {
    const bool is_candidate = name.back() == '1';
    const auto& values = features[is_candidate].at(name.substr(0, name.size() - 1));
    Bytes array(read_array(system + "/check/" + name + ".npy").size());
    if (is_candidate ? array.size() < values.size() : array.size() != values.size())
      throw std::runtime_error(name + ": expected a system that was exported with the keypoints of the extraction");
    std::copy(values.begin(), values.end(), array.begin());
    return array;
  });
  for (const auto& [name, bytes] : outputs)
    if (name != "shift") std::cout << name << ": " << numbers(name, bytes)[0] << "\n";
}

// PROGRAM FOLDER [TOLERANCE]: run the program of a folder on the inputs in the folder, and compare its outputs.
// PROGRAM EXTRACTION SYSTEM QUERY.ppm CANDIDATE.ppm: score an image pair by two folders.
inline int run_example(int argc, char** argv, Run run) {
  if (argc != 2 && argc != 3 && argc != 5) {
    std::cerr << "usage: " << argv[0] << " FOLDER [TOLERANCE]\n"
              << "       " << argv[0] << " EXTRACTION SYSTEM QUERY.ppm CANDIDATE.ppm\n";
    return 2;
  }
  try {
    for (int i = 1; i <= (argc == 5 ? 2 : 1); ++i)
      if (!std::ifstream(std::string(argv[i]) + "/program.onnx"))
        throw std::runtime_error(std::string(argv[i]) + ": expected program.onnx, got none; "
                                                        "pip install 'mfvpr[export]', and export again");
    if (argc == 5) {
      score_images(argv + 1, run);
      return 0;
    }
    const std::string folder = argv[1];
    const float tolerance = argc > 2 ? std::strtof(argv[2], nullptr) : 1e-4f;
    float largest = 0;
    const std::string check = folder + "/check/";
    const auto outputs = run(folder, [&](const std::string& name) { return read_array(check + name + ".npy"); });
    for (const auto& [name, bytes] : outputs) largest = std::max(largest, compare(folder, name, bytes));
    std::cout << "largest difference: " << largest << " (tolerance " << tolerance << ")\n";
    return largest <= tolerance ? 0 : 1;
  } catch (const std::exception& error) {
    std::cerr << error.what() << "\n";
    return 2;
  }
}
